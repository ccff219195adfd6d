// The panels beside the plan: a row for each robot, and what happened.
const CLASSES = { drives: "good", failed: "bad", troubled: "warn" }; // of states, by how they look

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

function number(value, digits) {
  return Number.isNaN(value) || value === undefined ? "–" : value.toFixed(digits);
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
    if (source.scene.series.age.some((value) => value !== null)) headings.push("oldest ms");
    if (source.scene.series.tick.some((value) => value !== null)) headings.push("tick µs");
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
      const [, state, reason] = this.source.state(index, frame.t);
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
      if (this.headings.includes("oldest ms")) texts.push(number(value("age_ms"), 0));
      if (this.headings.includes("tick µs")) texts.push(number(value("tick_us"), 0));
      texts.forEach((text, column) => {
        if (text !== null && cells[column].textContent !== text) cells[column].textContent = text;
      });
      cells[1].className = `text ${CLASSES[scene.looks[state]] || ""}`;
      cells[3].className = nearest < scene.safe_m ? "bad" : "";
      line.classList.toggle("chosen", index === chosen);
      if (reason && state !== "running") {
        const text = `${state}: ${reason}`;
        reasons.set(text, [...(reasons.get(text) || []), scene.robots[index].id]);
      }
    });
    const why = [...reasons].map(([text, ids]) => `${ids.length > 6 ? `${ids.length} robots` : ids.join(", ")} ${text}`);
    const shown = why.slice(0, 4).join("; ") + (why.length > 4 ? `; and ${why.length - 4} more` : "");
    if (this.why.textContent !== shown) this.why.textContent = shown;
  }
}

// What happened, in the order of time: a click goes there.
export class Events {
  constructor(parent, scene, onSeek) {
    const list = parent.querySelector("ol");
    this.items = scene.marks.map((mark) => {
      const item = element("li");
      const button = element("button", `${mark.t_s.toFixed(1)} s  ${mark.text}`, mark.kind);
      button.addEventListener("click", () => onSeek(Math.max(0, mark.t_s), mark));
      item.append(button);
      list.append(item);
      return { mark, button };
    });
    if (!this.items.length) parent.hidden = true;
  }

  show(t) {
    for (const { mark, button } of this.items) button.classList.toggle("past", mark.t_s <= t + 1e-6);
  }
}
