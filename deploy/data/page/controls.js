// What an operator orders of a running fleet, and who has done it. Nothing here asks back: STOP least of all.
import { element, LEVELS, Links } from "handfast/panels.js";
import { Reshape } from "handfast/reshape.js";

const AGAIN_MS = 300; // an order that the server has not been heard to know is said again
const LATE_MS = 3000; // as deploy/view/orders.py: after so long the server would refuse it
const AT_ONCE = 4; // of those that wait, so many are said again at a time
const SHOWN = 6;
const AWAY_M = 0.5; // a robot that stands is said to be away from its place
const FAULTS = [
  ["30 % lost", { loss: "30%" }],
  ["all lost", { loss: "100%" }],
  ["200 ms late", { delay: "200ms" }],
];
const LONG_S = [10, 30, 120];
const find = (id) => document.getElementById(id);

export class Controls {
  constructor(player, source) {
    Object.assign(this, { player, source, pending: new Map(), known: [], lost: [], serial: 0 });
    this.name = Array.from(crypto.getRandomValues(new Uint32Array(3)), (part) => part.toString(36)).join("");
    const index = (id) => source.scene.robots.findIndex((robot) => robot.id === id);
    const places = (link) => link.map(index).sort((a, b) => a - b);
    this.links = new Links(find("links"), source, (link) => player.choose(null, places(link)));
    player.plan.trouble = (i, j) => this.links.trouble(source.scene.robots[i].id, source.scene.robots[j].id);
    this.may = new Set();
    this.place = find("change");
    this.lists();
    find("stop").addEventListener("click", () => this.order({ kind: "stop" }));
    find("resume").addEventListener("click", () => this.order({ kind: "resume" }));
    window.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this.may.has("stop")) {
        event.preventDefault();
        if (!event.repeat) this.order({ kind: "stop" });
      }
    }, { capture: true });
    this.reshape = new Reshape(player, source, this);
    source.onPart = (parts) => this.told(parts);
    source.onOpen = () => this.again();
    player.onTold = () => {
      this.choice();
      this.standing();
    };
    setInterval(() => this.again(), AGAIN_MS);
    this.told(source.parts);
  }

  lists() {
    this.head = element("h2", "Orders");
    this.buttons = element("div", undefined, "row");
    this.orders = element("ol");
    this.place.append(this.head, this.buttons, this.orders);
  }

  // ---------------------------------------------------------------- on their way

  order(content) {
    this.serial += 1;
    const order = { ...content, id: `${this.name}-${this.serial}`, seen_s: this.source.made };
    this.pending.set(order.id, { order, given: performance.now() });
    this.source.say({ order });
    this.show();
  }

  // Until it is among those that the server tells of, an order may have been lost. A stop is said as long as
  // there is a page; what else was on its way for long is not what is wanted any more.
  again() {
    const now = performance.now();
    for (const [id, { order, given }] of this.pending) {
      if (order.kind !== "stop" && now - given > LATE_MS) {
        this.pending.delete(id);
        this.lost.push({ id, what: order.kind, over: true, done: false, lines: ["the server was not reached in time"] });
      }
    }
    for (const { order } of [...this.pending.values()].slice(0, AT_ONCE)) this.source.say({ order });
    if (this.pending.size) this.show();
  }

  // ---------------------------------------------------------------- what is told

  told({ controls, orders, panel, links, preview }) {
    if (controls) {
      this.may = new Set(controls);
      find("stop").hidden = !this.may.has("stop");
      this.place.hidden = !this.may.size;
    }
    if (orders) {
      this.known = orders;
      for (const { id } of orders) this.pending.delete(id);
    }
    if (panel) this.standing();
    if (links) this.links.show(links);
    if (preview) this.reshape.told(preview);
    this.show();
  }

  standing() {
    const { panel } = this.source.parts;
    if (!panel) return;
    const [here, all] = panel.present;
    const gone = here ? "" : "no process of the fleet is there any more: its drive is over, or it is out of reach";
    const stop = panel.stop && `${panel.stop}${this.behind()}`;
    const text = gone || stop || (here < all ? `${here} of ${all} processes there` : "");
    if (find("standing").textContent !== text) find("standing").textContent = text;
    find("resume").hidden = !panel.stop || !this.may.has("resume");
  }

  // The mission goes on while robots stand: a resume has them drive to where they should be by then.
  behind() {
    const { scene, row, columns, at } = this.source;
    const away = scene.robots.map((_, k) => {
      const of = (name) => row[k * columns + at[name]];
      return Math.hypot(of("x") - of("place_x"), of("y") - of("place_y"));
    });
    const most = Math.max(0, ...away.filter(Number.isFinite));
    return most > AWAY_M ? `; up to ${most.toFixed(1)} m from where they should be by now` : "";
  }

  show() {
    const items = [...this.pending.values()].map(({ order }) => ({ what: order.kind, lines: [], waits: true }));
    items.push(...alike([...this.known, ...this.lost.slice(-2)]).slice(-SHOWN).reverse());
    const made = items.map(({ what, over, done, count, lines, waits, times = 1 }) => {
      const item = element("li", undefined, done ? "done" : over ? "failed" : "");
      const told = count && lines.some((line) => line.startsWith(`${count[0]} of `));
      const so = done ? "" : over ? "in time, not all" : "...";
      const counted = count && !(told && !done) ? `${count[0]} of ${count[1]} ${so}` : so;
      const state = waits ? "the server has not answered yet" : count ? counted.trim() : "not given";
      item.append(element("strong", what), ` – ${state}${times > 1 ? ` (${times} times)` : ""}`);
      if (!done && lines.length) item.append(element("div", lines.join("; "), "soft"));
      return item;
    });
    const text = made.map((item) => item.textContent + item.className).join("\n");
    if (text === this.shown) return;
    this.shown = text;
    this.orders.replaceChildren(...made);
  }

  // Buttons for what is chosen: a robot, a link, or the whole fleet.
  choice() {
    const { panel } = this.source.parts;
    const { chosen, link } = this.player;
    const lines = chosen === null ? [] : this.source.lines(chosen);
    const key = JSON.stringify([lines, chosen, link, panel && panel.members, panel && panel.mission, [...this.may], this.reshape.active, panel && panel.faults]);
    if (key === this.chosenKey || !panel) return;
    this.chosenKey = key;
    const made = [];
    const button = (text, title, act) => {
      const each = element("button", text);
      each.title = title;
      each.addEventListener("click", act);
      made.push(each);
    };
    if (link && this.may.has("fault")) this.faults(link, made, button);
    else if (chosen !== null) this.robot(this.source.scene.robots[chosen].id, panel, button);
    else {
      if (this.may.has("start") && panel.mission === null) this.start(made, button);
      if (this.may.has("reshape") && panel.mission !== null) button(this.reshape.active ? "cancel reshaping" : "reshape", "Drag places of the formation (only then is anything ordered)", () => this.reshape.toggle());
    }
    if (this.reshape.active) made.push(...this.reshape.elements());
    if (this.may.has("heal") && panel.faults.some((text) => text.startsWith("live "))) {
      button("heal all links", "End all live fault rules", () => this.order({ kind: "heal" }));
    }
    if (lines.length) {
      const list = element("ul", undefined, "lines");
      for (const [name, level, found, advice] of lines) {
        list.append(element("li", `${name}: ${found}${advice ? ` (${advice})` : ""}`, LEVELS[level]));
      }
      made.push(list);
    }
    if (!made.length) made.push(element("span", "Choose a robot or a link for what can be ordered of it.", "soft"));
    this.buttons.replaceChildren(...made);
  }

  robot(id, panel, button) {
    const name = `robot ${id}`;
    if (panel.members.includes(id)) {
      if (this.may.has("leave")) button(`take ${name} out`, "It brakes and stays where it is; the others go on", () => this.order({ kind: "leave", robot: id }));
    } else if (this.may.has("join")) {
      const near = this.nearest(id, panel.members);
      button(`join ${name} to ${near.join(", ")}`, "It gets a place and edges to the members that are nearest to it", () => this.order({ kind: "join", robot: id, edges: near }));
    }
    if (this.may.has("resume")) button(`resume ${name}`, "Let it drive again, after its operator gave it back", () => this.order({ kind: "resume", robots: [id] }));
  }

  nearest(id, members) {
    const { scene, row, columns, at } = this.source;
    const place = (robot) => {
      const k = scene.robots.findIndex((each) => each.id === robot) * columns;
      return [row[k + at.x], row[k + at.y]];
    };
    const [x, y] = place(id);
    const away = (robot) => {
      const [u, v] = place(robot);
      return Math.hypot(u - x, v - y);
    };
    return [...members].sort((a, b) => away(a) - away(b)).slice(0, 2).sort((a, b) => a - b);
  }

  start(made, button) {
    const resume = element("input");
    resume.type = "checkbox";
    const label = element("label");
    label.append(resume, " also after a stop of somebody's");
    button("start the mission", "As `handfast drive --detach`: robots drive alone to its end", () => this.order({ kind: "start", resume: resume.checked }));
    made.push(label);
  }

  faults([a, b], made, button) {
    const long = element("select");
    for (const each of LONG_S) long.add(new Option(`${each} s`, each));
    made.push(element("span", `link ${a} – ${b}, for`), long);
    for (const [text, fields] of FAULTS) {
      button(text, "A fault rule on this link, both ways; it ends by itself", () => {
        this.order({ kind: "fault", rule: { link: `${a}<->${b}`, ...fields, for: `${long.value}s` } });
      });
    }
  }
}

// Orders one after the other of which the same became are one, said so many times.
function alike(orders) {
  const found = [];
  for (const order of orders) {
    const last = found[found.length - 1];
    const of = order.done ? ["what", "done", "count"] : ["what", "over", "done", "count", "lines"];
    const same = last && of.every((each) => String(order[each]) === String(last[each]));
    if (same) last.times += 1;
    else found.push({ ...order, times: 1 });
  }
  return found;
}
