// A running fleet as the page shows it: what is now, and what has been driven so far.
import { Controls } from "handfast/controls.js";
import { Player, problem } from "handfast/player.js";

const STALE_MS = 1500; // a server that says nothing for so long is gone, or stands
const AGAIN_MS = 1000; // pause between attempts to reach it
const BINS = 1000;
const BIN_S = 0.1;
const NUMBERS = 4_000_000; // of all that is kept of a drive; as deploy/view/live_fleet.py: of more every second row is left out

// Reaches the server, and shows the fleet once it has said what that is.
export function connected(checked) {
  return new Promise((keep, refuse) => {
    const source = new Live(checked, () => {
      const player = new Player(source);
      player.controls = new Controls(player, source);
      keep(player);
    }, refuse);
    source.open();
  });
}

export class Live {
  constructor(checked, onScene, onRefused) {
    Object.assign(this, { checked, onScene, onRefused, live: true, parts: {}, number: 0, received: 0, acked: 0, now: null, last: new Map() });
    this.token = new URLSearchParams(location.hash.slice(1)).get("token") || "";
    this.heardAt = performance.now();
    this.rate = 20;
    this.gone = 0;
    this.delays = [];
    setInterval(() => this.look(), 250);
    document.addEventListener("visibilitychange", () => {
      this.heardAt = performance.now();
      // A page that nobody sees draws nothing, so it is sent nothing.
      if (!document.hidden && this.scene) this.say({ past: true });
    });
  }

  // ---------------------------------------------------------------- the connection

  open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/live`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      socket.send(JSON.stringify({ token: this.token }));
      if (this.forces) this.wantForces(true);
      this.received = this.acked = 0;
      if (this.onOpen) this.onOpen();
    };
    socket.onmessage = ({ data }) => {
      this.heardAt = performance.now();
      if (typeof data === "string") this.told(JSON.parse(data));
      else this.moved(data);
    };
    socket.onclose = ({ code, reason }) => {
      if (code === 1008 || code === 1013) {
        this.refused = reason || "the server refuses this page";
        this.look();
        if (!this.scene) this.onRefused(new Error(this.refused));
        return;
      }
      if (!this.gone) this.gone = performance.now();
      this.look();
      setTimeout(() => this.open(), AGAIN_MS);
    };
  }

  say(content) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(content));
  }

  // Says at once when nothing is heard any more, and how old what is shown is.
  look() {
    const silent = performance.now() - this.heardAt;
    const over = this.parts.over && this.socket.readyState === WebSocket.OPEN;
    const stale = !over && (Boolean(this.refused) || this.socket.readyState !== WebSocket.OPEN || (silent > STALE_MS && !document.hidden));
    document.body.classList.toggle("stale", stale && Boolean(this.scene));
    this.stale = stale;
    if (!this.scene) return;
    const age = Math.max(0, silent / 1000).toFixed(silent < 9950 ? 1 : 0);
    if (this.refused) problem(`This page is told nothing any more: ${this.refused}. What is shown is ${age} s old.`);
    else if (over) problem("The drive is over; the recording comes in a moment.");
    else problem(stale ? `No connection to the server of this page: what is shown is ${age} s old. Robots go on as they were told; "handfast stop" stops them.` : "");
  }

  // ---------------------------------------------------------------- what is told

  told({ drive, parts = {}, logs = {} }) {
    this.gone = 0;
    Object.assign(this.parts, parts);
    if (parts.scene && !this.scene) {
      const { scene } = this.parts;
      this.checked(scene);
      Object.assign(scene, { live: true, marks: [], states: scene.robots.map(() => []), edges: [], end_s: 1, series: series() });
      this.scene = scene;
      this.columns = scene.columns.length;
      this.at = Object.fromEntries(scene.columns.map((name, index) => [name, index]));
      this.width = this.columns * scene.robots.length;
      this.row = new Float32Array(this.width).fill(NaN);
      this.past = new Float32Array(this.width).fill(NaN);
      this.stored = scene.frame_columns * scene.robots.length + 1;
      this.most = Math.max(2, Math.floor(NUMBERS / this.stored));
      this.forget();
    }
    if (drive !== undefined) this.forget();
    for (const mark of logs.events || []) this.happened(mark);
    for (const [t, robot, state, why] of logs.states || []) this.scene.states[robot].push([t, state, why]);
    for (const each of logs.edges || []) this.edges.push(each);
    this.length();
    if (this.onScene && parts.scene) {
      this.onScene();
      this.onScene = null;
    }
    if (parts.reload) location.replace(location.pathname); // the recording is at the same address
    if (this.onPart) this.onPart(parts);
  }

  // In the order of time: what was ordered before somebody looked may be heard of late.
  happened(mark) {
    const { marks } = this.scene;
    let k = marks.length;
    while (k > 0 && marks[k - 1].t_s > mark.t_s) k -= 1;
    if (k < marks.length) marks.order = (marks.order || 0) + 1;
    marks.splice(k, 0, mark);
  }

  // What the line of time spans: what is to be driven, and more once that is over.
  length() {
    const planned = this.parts.panel ? this.parts.panel.duration_s : 1;
    this.scene.end_s = this.end <= planned ? planned : Math.ceil(this.end / 10) * 10;
  }

  // Another drive begins, or what is known of this one comes again.
  forget() {
    const { scene } = this;
    scene.marks.length = 0;
    scene.states.forEach((changes) => (changes.length = 0));
    Object.assign(scene.series, series());
    this.edges = [];
    this.rows = new Float32Array(1024 * this.stored);
    this.count = this.offered = 0;
    this.stride = 1;
    this.end = 0;
    this.bin = BIN_S;
  }

  moved(data) {
    const head = new DataView(data);
    const [t, made, number, columns] = [head.getFloat64(0, true), head.getFloat64(8, true), head.getUint32(16, true), head.getUint32(20, true)];
    const numbers = new Float32Array(data, 24);
    if (!columns) return this.came(numbers, number);
    this.keepLast();
    this.received += 1;
    this.number = number;
    this.made = made;
    this.arrived = performance.now();
    this.now = Number.isNaN(t) ? null : t;
    const robots = this.scene.robots.length;
    if (columns === this.columns) this.row.set(numbers);
    else for (let k = 0; k < robots; k++) this.row.set(numbers.subarray(k * columns, (k + 1) * columns), k * this.columns);
    if (this.now !== null && this.now >= 0 && this.now > this.end) this.keep();
    return undefined;
  }

  // Where each body was when it was heard last.
  keepLast() {
    this.scene.robots.forEach((_, k) => {
      const [x, y, heading] = this.row.subarray(k * this.columns, k * this.columns + 3);
      if (!Number.isNaN(x)) this.last.set(k, { x, y, heading, at: this.arrived });
    });
  }

  // All rows of the drive until now.
  came(rows, stride) {
    Object.assign(this.scene.series, series());
    this.bin = BIN_S;
    this.stride = stride;
    this.count = rows.length / this.stored;
    this.offered = this.count * stride;
    this.rows = rows.slice();
    for (let k = 0; k < this.count; k++) {
      this.fill(this.past, k);
      this.end = rows[k * this.stored];
      this.measure(this.end, this.past, null);
    }
  }

  keep() {
    this.end = this.now;
    this.length();
    this.measure(this.now, this.row, this.edges.length ? this.edges[this.edges.length - 1][1] : []);
    this.offered += 1;
    if ((this.offered - 1) % this.stride) return;
    if (this.count === this.most) {
      for (let k = 0; 2 * k < this.count; k++) this.rows.copyWithin(k * this.stored, 2 * k * this.stored, (2 * k + 1) * this.stored);
      this.count = Math.ceil(this.count / 2);
      this.stride *= 2;
      if ((this.offered - 1) % this.stride) return;
    }
    if ((this.count + 1) * this.stored > this.rows.length) {
      const more = new Float32Array(Math.min(2 * this.rows.length, this.most * this.stored) + this.stored);
      more.set(this.rows);
      this.rows = more;
    }
    const from = this.count * this.stored;
    const each = this.scene.frame_columns;
    this.rows[from] = this.now;
    this.scene.robots.forEach((_, k) => {
      this.rows.set(this.row.subarray(k * this.columns, k * this.columns + each), from + 1 + k * each);
    });
    this.count += 1;
  }

  // Writes a row that was kept into one as the newest is; forces were not kept.
  fill(row, k) {
    const each = this.scene.frame_columns;
    const from = k * this.stored + 1;
    row.fill(NaN);
    this.scene.robots.forEach((_, robot) => {
      row.set(this.rows.subarray(from + robot * each, from + (robot + 1) * each), robot * this.columns);
    });
  }

  // ---------------------------------------------------------------- curves

  measure(t, row, edges) {
    const { scene, columns, at } = this;
    const { series: all } = scene;
    const robots = scene.robots.length;
    const of = (robot, name) => row[robot * columns + at[name]];
    let nearest = Infinity;
    let [tracking, tick, age] = [-1, -1, -1];
    for (let i = 0; i < robots; i++) {
      const [x, y] = [of(i, "x"), of(i, "y")];
      for (let j = i + 1; j < robots; j++) {
        const away = Math.hypot(x - of(j, "x"), y - of(j, "y"));
        if (away < nearest) nearest = away;
      }
      tracking = Math.max(tracking, number(Math.hypot(x - of(i, "place_x"), y - of(i, "place_y"))));
      tick = Math.max(tick, number(of(i, "tick_us")));
      age = Math.max(age, number(of(i, "age_ms")));
    }
    let error = -1;
    for (const [i, j, wanted] of edges || this.edgesAt(t)) {
      error = Math.max(error, number(Math.abs(Math.hypot(of(i, "x") - of(j, "x"), of(i, "y") - of(j, "y")) - wanted)));
    }
    const last = all.t.length - 1;
    if (last < 0 || t >= all.t[last] + this.bin) {
      if (all.t.length >= BINS) this.coarser();
      all.t.push(t);
      for (const name of ["nearest", "error", "tracking", "tick", "age"]) all[name].push(null);
    }
    const put = (name, value, better) => {
      const k = all.t.length - 1;
      if (value < 0 || !Number.isFinite(value)) return;
      all[name][k] = all[name][k] === null ? value : better(all[name][k], value);
    };
    put("nearest", nearest, Math.min);
    put("error", error, Math.max);
    put("tracking", tracking, Math.max);
    put("tick", tick, Math.max);
    put("age", age, Math.max);
    all.version = Math.floor(t * 2);
  }

  coarser() {
    const { series: all } = this.scene;
    this.bin *= 2;
    const halved = (values, better) => values.filter((_, k) => k % 2 === 0).map((value, k) => {
      const other = values[2 * k + 1];
      return other === null || other === undefined ? value : value === null ? other : better(value, other);
    });
    for (const name of ["error", "tracking", "tick", "age"]) all[name] = halved(all[name], Math.max);
    all.nearest = halved(all.nearest, Math.min);
    all.t = all.t.filter((_, k) => k % 2 === 0);
  }

  // ---------------------------------------------------------------- what is asked by who draws

  // The robots at fleet time t, or now (null): {t, row, number, exact, now}.
  frame(t) {
    if (t === null) return { t: this.now ?? 0, row: this.row, number: this.number, exact: true, now: true };
    const k = this.find(t);
    if (k < 0) return { t, row: this.past.fill(NaN), number: 0, exact: true, now: false };
    this.fill(this.past, k);
    return { t, row: this.past, number: 0, exact: true, now: false };
  }

  // The last row that was kept at or before t, -1 without any.
  find(t) {
    let [low, high] = [0, this.count];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.rows[middle * this.stored] <= t + 1e-4) low = middle + 1;
      else high = middle;
    }
    return Math.min(low, this.count) - 1;
  }

  want() {
    return Promise.resolve();
  }

  edgesAt(t) {
    let k = this.edges.length - 1;
    while (k > 0 && this.edges[k][0] > t) k -= 1;
    return k < 0 ? [] : this.edges[k][1];
  }

  eachEdge({ t, now }, put) {
    const edges = now && this.edges.length ? this.edges[this.edges.length - 1][1] : this.edgesAt(t);
    for (const [i, j, wanted] of edges) put(i, j, wanted);
  }

  path(robot, from, to, put) {
    const each = this.scene.frame_columns;
    for (let k = Math.max(0, this.find(from)); k < this.count; k++) {
      const row = k * this.stored;
      if (this.rows[row] > to) break;
      put(this.rows[row + 1 + robot * each], this.rows[row + 2 + robot * each]);
    }
  }

  // State of a robot, and why: what is so now tells how long already.
  state(robot, t, now = false) {
    const changes = this.scene.states[robot];
    const newest = changes[changes.length - 1];
    if (now && newest) {
      const why = this.parts.panel && this.parts.panel.why[this.scene.robots[robot].id];
      return why && why[0] === newest[1] ? [newest[0], ...why] : newest;
    }
    if (t >= this.end || this.now === null) return newest || [0, "", "nothing heard yet"];
    let k = changes.length - 1;
    while (k > 0 && changes[k][0] > t) k -= 1;
    return changes[k] || [0, "", ""];
  }

  // What a vehicle's bridge says of it: [name, level, found, advice] each.
  lines(robot) {
    const { panel } = this.parts;
    return (panel && panel.checks[this.scene.robots[robot].id]) || [];
  }

  line(robot, wanted) {
    return this.lines(robot).find(([name]) => name === wanted);
  }

  // What else is to be known of a robot now.
  note(robot) {
    const { panel } = this.parts;
    if (!panel) return "";
    const lines = this.lines(robot).filter(([, level]) => level === "blocking").map(([name, , found]) => `${name}: ${found}`);
    return [panel.notes[this.scene.robots[robot].id], ...lines].filter(Boolean).join("; ");
  }

  // The earliest moment that is known here.
  get begin() {
    return this.count ? this.rows[0] : 0;
  }

  // What the page shows: what is now, or what was.
  how(t, follows) {
    if (follows) return this.parts.controls && !this.parts.controls.length ? 'live, to be looked at only ("handfast stop" stops it)' : "live";
    return `looking back ${Math.max(0, (this.now ?? this.end) - t).toFixed(0)} s (the list of links is of now)`;
  }

  timeText(t, follows) {
    if (!follows) return `${t.toFixed(2)} of ${this.end.toFixed(1)} s`;
    if (this.now === null) return "no mission yet";
    const of = this.parts.panel ? ` of ${this.parts.panel.duration_s.toFixed(0)} s` : "";
    return `${this.now.toFixed(1)}${of}`;
  }

  wantForces(on) {
    this.forces = on;
    this.say({ forces: on });
  }

  // The newest frame is on the screen.
  drawn() {
    if (this.received === this.acked || this.socket.readyState !== WebSocket.OPEN) return;
    this.acked = this.received;
    this.socket.send(String(this.acked));
    this.delays.push(performance.now() - this.arrived);
    if (this.delays.length > 2000) this.delays.shift();
  }
}

function series() {
  return { t: [], nearest: [], error: [], tracking: [], tick: [], age: [], edges: [], version: 0 };
}

function number(value) {
  return Number.isNaN(value) ? -1 : value;
}
