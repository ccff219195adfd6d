// The panels beside the plan: a row for each robot, and what happened.
const CLASSES = { drives: "good", failed: "bad", troubled: "warn" }; // of states, by how they look
const TROUBLE = 0.02; // a link that loses a greater share is marked
const REASONS = 4; // so many are told
const SILENT_MS = 500; // a link over which nothing has come for so long, or for some ticks, is silent
const SILENT_TICKS = 5;
const LATELY = 4; // what was lost is counted over so many times that links are told of, half a second each
export const LEVELS = { warning: "warn", blocking: "bad" }; // classes of what checks say

export function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

function number(value, digits) {
  return Number.isNaN(value) || value === undefined ? "–" : value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1");
}

// Of many reasons those that differ by their numbers alone are one.
function byKind(reasons) {
  const found = new Map();
  for (const [text, ids] of reasons) {
    const kind = text.replace(/\d+(\.\d+)?/g, "#");
    const known = found.get(kind);
    found.set(kind, known ? [`${known[0].replace(/, or alike$/, "")}, or alike`, [...known[1], ...ids]] : [text, ids]);
  }
  return found.values();
}

// A row for each robot: state and why, how far from its place, nearest robot, speed, age of messages, tick.
export class Robots {
  constructor(parent, source, onChoose) {
    this.source = source;
    parent.append(element("h2", `Robots (${source.scene.robots.length})`));
    const table = element("table");
    const head = element("tr");
    // What nobody has, as ticks in virtual time take no time, has no column.
    const headings = ["robot", "state", "off place m", "nearest m", "speed m/s"];
    const { live, series } = source.scene;
    // What bridges say of vehicles, as they say it.
    this.lines = live && source.scene.robots.some(({ vehicle }) => vehicle) ? ["battery", "mode"] : [];
    headings.push(...this.lines);
    if (live || series.age.some((value) => value !== null)) headings.push("oldest ms");
    if (live || series.tick.some((value) => value !== null)) headings.push("tick µs");
    this.headings = headings;
    headings.forEach((name, index) => head.append(element("th", name, index === 1 ? "text" : "")));
    const thead = element("thead");
    thead.append(head);
    const body = element("tbody");
    this.rows = source.scene.robots.map((robot, index) => {
      const row = element("tr");
      row.tabIndex = 0;
      const cells = headings.map((_, column) => element("td", column ? "" : String(robot.id), column === 1 ? "text" : ""));
      row.append(...cells);
      row.addEventListener("click", () => onChoose(index));
      row.addEventListener("keydown", (event) => event.key === "Enter" && onChoose(index));
      body.append(row);
      return { row, cells };
    });
    table.append(thead, body);
    const rows = element("div", undefined, "rows");
    rows.append(table);
    this.why = element("p", "", "soft");
    parent.append(rows, this.why);
  }

  show(frame, chosen) {
    const { at, columns, scene } = this.source;
    const { row } = frame;
    const place = scene.robots.map((_, index) => [row[index * columns + at.x], row[index * columns + at.y]]);
    const reasons = new Map();
    this.rows.forEach(({ row: line, cells }, index) => {
      const value = (name) => row[index * columns + at[name]];
      const [, state, reason] = this.source.state(index, frame.t, frame.now);
      const [x, y] = place[index];
      let [nearest, who] = [Infinity, null];
      place.forEach(([u, v], other) => {
        const away = Math.hypot(x - u, y - v);
        if (other !== index && away < nearest) [nearest, who] = [away, scene.robots[other].id];
      });
      const texts = [
        null, state || "–", number(Math.hypot(x - value("place_x"), y - value("place_y")), 2),
        who === null ? "–" : `${nearest.toFixed(2)} (${who})`, number(value("speed"), 2),
      ];
      for (const name of this.lines) {
        const line = this.source.line(index, name);
        cells[texts.length].className = LEVELS[line && line[1]] || "";
        texts.push(line ? line[2].split(", ").pop() : "–");
      }
      if (this.headings.includes("oldest ms")) texts.push(number(value("age_ms"), 0));
      if (this.headings.includes("tick µs")) texts.push(number(value("tick_us"), 0));
      texts.forEach((text, column) => {
        if (text !== null && cells[column].textContent !== text) cells[column].textContent = text;
      });
      cells[1].className = `text ${CLASSES[scene.looks[state]] || ""}`;
      cells[3].className = nearest < scene.safe_m ? "bad" : "";
      line.classList.toggle("chosen", index === chosen);
      const note = this.source.note ? this.source.note(index) : "";
      for (const text of [reason && state !== "running" ? `${state}: ${reason}` : "", note].filter(Boolean)) {
        reasons.set(text, [...(reasons.get(text) || []), scene.robots[index].id]);
      }
    });
    const why = [...(reasons.size > REASONS ? byKind(reasons) : reasons)].map(([text, ids]) => {
      return `${ids.length > 6 ? `${ids.length} robots` : ids.join(", ")} ${text}`;
    });
    const shown = why.slice(0, REASONS).join("; ") + (why.length > REASONS ? `; and ${why.length - REASONS} more` : "");
    if (this.why.textContent !== shown) this.why.textContent = shown;
  }
}

// What happened, in the order of time: a click goes there. Of a running fleet the list grows.
export class Events {
  constructor(parent, scene, onSeek) {
    Object.assign(this, { parent, scene, onSeek, list: parent.querySelector("ol"), items: [] });
    this.grow();
  }

  grow() {
    const { list, items, scene: { marks } } = this;
    if (items.length > marks.length || this.order !== marks.order) {
      this.order = marks.order;
      items.length = 0; // another drive, or one has come that belongs between others
      list.replaceChildren();
    }
    if (items.length < marks.length) {
      const atEnd = list.scrollTop + list.clientHeight > list.scrollHeight - 30;
      for (const mark of marks.slice(items.length)) {
        const item = element("li");
        const button = element("button", `${mark.t_s.toFixed(1)} s  ${mark.text}`, mark.kind);
        button.addEventListener("click", () => this.onSeek(Math.max(0, mark.t_s), mark));
        item.append(button);
        list.append(item);
        items.push({ mark, button });
      }
      if (atEnd && this.scene.live) list.scrollTop = list.scrollHeight;
    }
    this.parent.hidden = !items.length;
  }

  show(t) {
    this.grow();
    for (const { mark, button } of this.items) button.classList.toggle("past", mark.t_s <= t + 1e-6);
  }
}

// How each link is: of those that hear each other, the age of the newest message and what was lost lately.
export class Links {
  constructor(parent, source, onChoose) {
    Object.assign(this, { parent, source, onChoose, before: new Map(), lost: new Map(), age: new Map() });
    this.periodMs = 1000 / source.scene.rate_hz;
    this.table = element("table");
    parent.append(element("h2", "Links: age of the last message in ms, lost of late"), this.table);
    parent.hidden = true;
  }

  isSilent(age) {
    return age < 0 || age > Math.max(SILENT_MS, SILENT_TICKS * this.periodMs);
  }

  // What is wrong with the link between two robots, "" for nothing: silence, or the share that was lost, of
  // the way that is worse.
  trouble(one, other) {
    const both = [`${one} ${other}`, `${other} ${one}`];
    const silent = both.map((key) => this.age.get(key)).filter((age) => age !== undefined && this.isSilent(age));
    if (silent.length) return silent.some((age) => age < 0) ? "never heard" : `silent ${(Math.max(...silent) / 1000).toFixed(1)} s`;
    const lost = Math.max(...both.map((key) => this.lost.get(key) || 0));
    return lost > TROUBLE ? `${(100 * lost).toFixed(0)} % lost` : "";
  }

  show(links) {
    const { scene } = this.source;
    this.age = new Map(links.map(([from, to, age]) => [`${from} ${to}`, age]));
    const ids = scene.robots.map(({ id }) => id);
    for (const [from, to, age, received, counted] of links) {
      const key = `${from} ${to}`;
      const past = this.before.get(key) || [];
      // What is lost is counted as the next message comes; of a silent link that is what should have come since.
      const lost = counted + (this.isSilent(age) && age > 0 ? Math.floor(age / this.periodMs) : 0);
      past.push([received, lost]);
      if (past.length > LATELY) past.shift();
      this.before.set(key, past);
      const [[r0, l0]] = past;
      const all = received - r0 + lost - l0;
      this.lost.set(key, all > 0 ? Math.min(Math.max((lost - l0) / all, 0), 1) : 0);
    }
    this.parent.hidden = !links.length;
    // Of many robots only those links that have something wrong.
    const bad = links.filter(([from, to, age]) => this.isSilent(age) || this.lost.get(`${from} ${to}`) > 0.01);
    if (ids.length > 12) return this.list(bad, links.length);
    const cells = new Map(links.map((each) => [`${each[0]} ${each[1]}`, each]));
    const rows = [["to \\ from", ...ids].map((text) => ({ text }))];
    for (const to of ids) {
      rows.push([{ text: to }, ...ids.map((from) => {
        const link = cells.get(`${from} ${to}`);
        if (!link) return { text: "" };
        const lost = this.lost.get(`${from} ${to}`);
        const text = link[2] < 0 ? "never" : `${link[2]}${lost > 0.005 ? ` ${(100 * lost).toFixed(0)}%` : ""}`;
        return { text, link, className: this.isSilent(link[2]) || lost > 0.2 ? "bad" : lost > 0.01 ? "warn" : "" };
      })]);
    }
    return this.fill(rows);
  }

  list(bad, count) {
    const rows = [[{ text: `${count} links, ${bad.length} of which lose messages or are silent` }]];
    bad.sort(([, , one], [, , other]) => this.isSilent(other) - this.isSilent(one));
    for (const [from, to, age] of bad.slice(0, 20)) {
      const lost = this.lost.get(`${from} ${to}`);
      const text = `${from} to ${to}: ${age < 0 ? "never heard" : `${age} ms`}, ${(100 * lost).toFixed(0)} % lost`;
      rows.push([{ text, link: [from, to], className: this.isSilent(age) ? "bad" : "warn" }]);
    }
    return this.fill(rows);
  }

  // Cells that stay where they are only get another text: who has come to one by its key stays there.
  fill(rows) {
    const shape = rows.map((cells) => cells.length).join();
    if (shape !== this.shape) {
      this.shape = shape;
      this.cells = rows.map((cells, number) => cells.map(() => this.cell(number ? "td" : "th")));
      this.table.replaceChildren(...this.cells.map((cells) => {
        const row = element("tr");
        row.append(...cells);
        return row;
      }));
    }
    rows.forEach((cells, number) => cells.forEach(({ text, link = null, className = "" }, column) => {
      const cell = this.cells[number][column];
      if (cell.textContent !== String(text)) cell.textContent = text;
      cell.className = className + (link ? " choice" : "");
      cell.tabIndex = link ? 0 : -1;
      cell.link = link;
    }));
  }

  // One of a link chooses that.
  cell(name) {
    const made = element(name);
    const choose = () => made.link && this.onChoose(made.link.slice(0, 2));
    made.addEventListener("click", choose);
    made.addEventListener("keydown", (event) => event.key === "Enter" && choose());
    return made;
  }
}
