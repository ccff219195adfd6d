// The plan view: a canvas on which the fleet is seen from above, east to the right, north up; how it is moved
// and zoomed, and what is chosen on it.
import { Drawing } from "handfast/drawing.js";

const MARGIN = 0.12;
const CLICK_PX = 4; // who moves the pointer by less has clicked
const [TOP_PX, BOTTOM_PX] = [40, 24]; // buttons and legend are there

export class Plan extends Drawing {
  constructor(canvas, source, onChoose) {
    super();
    Object.assign(this, { canvas, source, onChoose });
    this.show = { trails: true, places: true, forces: false };
    this.follow = false;
    this.chosen = null;
    this.scale = 50; // pixels a metre
    this.centre = [0, 0];
    this.fitted = false;
    this.near = false; // what was shown whole last were robots and places alone
    this.auto = true; // as long as nobody moves it; of a running fleet all robots are kept in the picture then
    this.pointers = new Map();
    this.listen();
  }

  // All that decides what is drawn of a moment, but the moment.
  look() {
    return [this.centre, this.scale, this.show, this.follow, this.fitted, this.link, this.dragged];
  }

  // ---------------------------------------------------------------- where is what

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.width === width && this.height === height && this.ratio === ratio) return;
    Object.assign(this, { width, height, ratio });
    if (this.auto) this.fitted = false;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
  }

  toScreen(x, y) {
    return [
      this.width / 2 + (x - this.centre[0]) * this.scale,
      this.height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  toWorld(px, py) {
    return [
      this.centre[0] + (px - this.width / 2) / this.scale,
      this.centre[1] - (py - this.height / 2) / this.scale,
    ];
  }

  // Shows all that there is: the whole way of all robots, obstacles and the fence; or, near, the robots alone
  // where they are and should be: on a long way they are too small to see.
  fit(near = false) {
    this.resize();
    const { source } = this;
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    const take = (x, y) => {
      if (!Number.isFinite(x) || !Number.isFinite(y)) return;
      x0 = Math.min(x0, x);
      x1 = Math.max(x1, x);
      y0 = Math.min(y0, y);
      y1 = Math.max(y1, y);
    };
    this.near = near;
    if (!near) source.scene.robots.forEach((_, robot) => source.path(robot, 0, Infinity, take));
    if (near || source.live) this.eachPlace(take);
    for (const each of near ? [] : source.scene.obstacles) {
      if (each.points) each.points.forEach(([x, y]) => take(x, y));
      else {
        take(each.x - each.radius, each.y - each.radius);
        take(each.x + each.radius, each.y + each.radius);
      }
    }
    if (!Number.isFinite(x0)) return;
    const room = Math.max(x1 - x0, y1 - y0, 1) * MARGIN;
    const height = Math.max(this.height - TOP_PX - BOTTOM_PX, this.height / 2);
    this.scale = Math.min(this.width / (x1 - x0 + 2 * room), height / (y1 - y0 + 2 * room));
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2 + (TOP_PX - BOTTOM_PX) / 2 / this.scale];
    this.fitted = true;
  }

  // Where robots are in what is shown, and where they should be.
  eachPlace(put) {
    const { at, columns, scene } = this.source;
    const { row } = this.frame;
    scene.robots.forEach(({ hand_m }, k) => {
      const [x, y] = [row[k * columns + at.x], row[k * columns + at.y]];
      const body = 2 * Math.abs(hand_m); // it is about as long, on any side of its hand
      put(x - body, y - body);
      put(x + body, y + body);
      put(row[k * columns + at.place_x], row[k * columns + at.place_y]);
    });
  }

  // What somebody has moved or zoomed is shown again after a reload, as when a run's recording takes its place.
  remember() {
    const { centre, scale, follow, show } = this;
    if (this.auto || !this.fitted) sessionStorage.removeItem(this.name());
    else sessionStorage.setItem(this.name(), JSON.stringify({ centre, scale, follow, show }));
  }

  recall() {
    const kept = sessionStorage.getItem(this.name());
    if (!kept) return;
    const { centre, scale, follow, show } = JSON.parse(kept);
    Object.assign(this, { centre, scale, follow, fitted: true, auto: false });
    Object.assign(this.show, { ...show, forces: false });
  }

  name() {
    return `handfast plan of ${this.source.scene.fleet}`;
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    this.auto = false;
    const [x, y] = this.toWorld(px, py);
    this.scale = Math.min(Math.max(this.scale * factor, 0.01), 20000);
    const [nx, ny] = this.toWorld(px, py);
    this.centre = [this.centre[0] + x - nx, this.centre[1] + y - ny];
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
      this.moved = 0;
      this.held = pointers.size === 1 && this.grab ? this.grab(event.offsetX, event.offsetY) : null;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const here = [event.offsetX, event.offsetY];
      const passed = Math.hypot(here[0] - before[0], here[1] - before[1]);
      this.moved += passed;
      if (this.moved > CLICK_PX && !this.held) this.auto = false;
      const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, each]) => each);
      if (others.length) {
        const apart = (a) => Math.hypot(a[0] - others[0][0], a[1] - others[0][1]);
        this.zoom(apart(here) / Math.max(apart(before), 1), others[0][0], others[0][1]);
      } else if (this.held) {
        this.held((here[0] - before[0]) / this.scale, -(here[1] - before[1]) / this.scale);
        this.dragged = (this.dragged || 0) + 1;
      } else {
        this.centre[0] -= (here[0] - before[0]) / this.scale;
        this.centre[1] += (here[1] - before[1]) / this.scale;
      }
      pointers.set(event.pointerId, here);
    });
    const end = (event) => {
      if (!pointers.delete(event.pointerId) || event.type !== "pointerup" || this.moved > CLICK_PX) return;
      const robot = this.nearest(event.offsetX, event.offsetY);
      this.onChoose(robot, robot === null ? this.edgeAt(event.offsetX, event.offsetY) : null);
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
  }

  // Index of the robot that is nearest to a place on the screen, null where none is near.
  nearest(px, py) {
    let [found, least] = [null, 24];
    (this.drawn || []).forEach((place, index) => {
      if (!place) return;
      const away = Math.hypot(place[0] - px, place[1] - py);
      if (away < least) [found, least] = [index, away];
    });
    return found;
  }

  // The edge that is nearest to a place on the screen, as places of its robots; null where none is near.
  edgeAt(px, py) {
    let [found, least] = [null, 8];
    if (!this.frame) return null;
    this.source.eachEdge(this.frame, (i, j) => {
      const [a, b] = [this.drawn[i], this.drawn[j]];
      if (!a || !b) return;
      const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
      const share = Math.min(Math.max(((px - a[0]) * dx + (py - a[1]) * dy) / (dx * dx + dy * dy || 1), 0), 1);
      const away = Math.hypot(px - a[0] - share * dx, py - a[1] - share * dy);
      if (away < least) [found, least] = [[i, j], away];
    });
    return found;
  }

  // ---------------------------------------------------------------- drawing

  draw(frame) {
    this.frame = frame;
    this.resize();
    if (!this.fitted || (this.auto && this.source.live && !this.follow && this.isOutside(frame.row))) this.fit(this.near);
    const style = getComputedStyle(document.documentElement);
    this.theme = Object.fromEntries(
      ["ink", "soft", "line", "page", "card", "accent", "robot", "fence", "warn", "bad"].map((name) => [
        name, style.getPropertyValue(`--${name}`).trim(),
      ]),
    );
    if (this.follow) this.centreOn(frame.row);
    const c = this.canvas.getContext("2d");
    this.c = c;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = this.theme.page;
    c.fillRect(0, 0, this.width, this.height);
    this.grid();
    this.ground();
    if (this.show.trails) this.trails(frame);
    this.edges(frame);
    if (frame.now) this.silent();
    this.robots(frame);
    if (this.over) this.over(frame);
  }

  isOutside(row) {
    const { at, columns, scene } = this.source;
    return scene.robots.some((_, k) => {
      const [px, py] = this.toScreen(row[k * columns + at.x], row[k * columns + at.y]);
      return px < 0 || py < TOP_PX || px > this.width || py > this.height - BOTTOM_PX;
    });
  }

  centreOn(row) {
    const { at, columns, scene } = this.source;
    let [sumX, sumY, count] = [0, 0, 0];
    scene.robots.forEach((_, index) => {
      if (this.chosen !== null && index !== this.chosen) return;
      const [x, y] = [row[index * columns + at.x], row[index * columns + at.y]];
      if (Number.isNaN(x)) return;
      sumX += x;
      sumY += y;
      count += 1;
    });
    if (count && !this.pointers.size) this.centre = [sumX / count, sumY / count];
  }
}
