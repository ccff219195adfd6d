// What is drawn of a moment, one thing after the other, on the canvas of a `Plan`.

const TRAIL_S = 20;
const SAID_PX = 90; // an edge that is shorter on the screen has a dot instead of a text
const LINE_PX = 14; // height of a label
const FORCE_PX = 80; // a force of 1 m/s2 is drawn so long
const FORCE_PX_MAX = 160;

// Of colours that people with any kind of colour blindness can tell apart (Okabe and Ito).
export const COLORS = { holds: "#009e73", off: "#e69f00", bad: "#d55e00", navigation: "#0072b2", constraint: "#cc79a7" };

// Needs of who extends it: c, canvas' context; source, theme, scale, show, chosen, link; toScreen, toWorld.
export class Drawing {
  // Where robots that are not heard are believed to be: somewhere on a way, give or take.
  silent() {
    const { c, source } = this;
    const { panel } = source.parts;
    c.strokeStyle = c.fillStyle = this.theme.bad;
    for (const { robot, x, y, to_x, to_y, doubt_m } of panel ? panel.silent : []) {
      const width = Math.max(2 * doubt_m * this.scale, 10);
      c.globalAlpha = 0.2;
      c.lineWidth = width;
      c.lineCap = "round";
      c.beginPath();
      c.moveTo(...this.toScreen(x, y));
      c.lineTo(...this.toScreen(to_x, to_y));
      c.lineTo(this.toScreen(to_x, to_y)[0] + 0.1, this.toScreen(to_x, to_y)[1]);
      c.stroke();
      c.globalAlpha = 1;
      c.font = "12px system-ui, sans-serif";
      const [px, py] = this.toScreen((x + to_x) / 2, (y + to_y) / 2);
      c.fillText(`${robot}?`, px + 6, py + 17); // below: above is the label of where it was seen last
    }
    c.lineCap = "butt";
  }

  grid() {
    const { c } = this;
    this.step = 10 ** Math.ceil(Math.log10(60 / this.scale));
    if (this.step * this.scale > 300) this.step /= 5;
    else if (this.step * this.scale > 150) this.step /= 2;
    const [x0, y1] = this.toWorld(0, 0);
    const [x1, y0] = this.toWorld(this.width, this.height);
    c.strokeStyle = this.theme.line;
    c.globalAlpha = 0.5;
    c.lineWidth = 1;
    c.beginPath();
    for (let x = Math.ceil(x0 / this.step) * this.step; x <= x1; x += this.step) {
      const px = Math.round(this.toScreen(x, 0)[0]) + 0.5;
      c.moveTo(px, 0);
      c.lineTo(px, this.height);
    }
    for (let y = Math.ceil(y0 / this.step) * this.step; y <= y1; y += this.step) {
      const py = Math.round(this.toScreen(0, y)[1]) + 0.5;
      c.moveTo(0, py);
      c.lineTo(this.width, py);
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  polygon(points) {
    this.c.beginPath();
    points.forEach(([x, y], index) => {
      const [px, py] = this.toScreen(x, y);
      if (index) this.c.lineTo(px, py);
      else this.c.moveTo(px, py);
    });
    this.c.closePath();
  }

  ground() {
    const { c, source: { scene } } = this;
    for (const each of scene.obstacles) {
      if (each.points) this.polygon(each.points);
      else {
        c.beginPath();
        c.arc(...this.toScreen(each.x, each.y), each.radius * this.scale, 0, 2 * Math.PI);
      }
      c.fillStyle = this.theme.soft;
      c.globalAlpha = 0.35;
      c.fill();
      c.globalAlpha = 1;
      c.strokeStyle = this.theme.soft;
      c.lineWidth = 1;
      c.stroke();
    }
    if (scene.fence) {
      this.polygon(scene.fence);
      c.strokeStyle = this.theme.fence;
      c.lineWidth = 2;
      c.setLineDash([8, 5]);
      c.stroke();
      c.setLineDash([]);
    }
  }

  trails(frame) {
    const { c, source } = this;
    const { at, columns } = source;
    c.strokeStyle = this.theme.robot;
    c.lineWidth = 1.2;
    c.globalAlpha = 0.45;
    c.beginPath();
    for (let robot = 0; robot < source.scene.robots.length; robot++) {
      let drawing = false;
      const point = (x, y) => {
        if (Number.isNaN(x)) return (drawing = false);
        const [px, py] = this.toScreen(x, y);
        if (drawing) c.lineTo(px, py);
        else c.moveTo(px, py);
        return (drawing = true);
      };
      source.path(robot, frame.t - TRAIL_S, frame.t, point);
      point(frame.row[robot * columns + at.x], frame.row[robot * columns + at.y]);
    }
    c.stroke();
    c.globalAlpha = 1;
  }

  // An edge that holds is a thin line; one that is too long is dashed, one that is too short dotted and thick.
  edges(frame) {
    const { c, source } = this;
    const { at, columns, scene } = source;
    const { row } = frame;
    const few = scene.robots.length <= 30;
    const settled = scene.settled; // an edge that is off by less holds
    source.eachEdge(frame, (i, j, wanted) => {
      const [x, y] = [row[i * columns + at.x], row[i * columns + at.y]];
      const [u, v] = [row[j * columns + at.x], row[j * columns + at.y]];
      if (Number.isNaN(x) || Number.isNaN(u)) return;
      const distance = Math.hypot(x - u, y - v);
      const off = distance / wanted - 1;
      const unsafe = distance < scene.safe_m;
      const chosen = this.link && this.link.includes(i) && this.link.includes(j);
      c.strokeStyle = unsafe ? COLORS.bad : Math.abs(off) <= settled ? COLORS.holds : COLORS.off;
      c.lineWidth = (unsafe ? 4 : off < -settled ? 2.6 : 1.6) * (few ? 1 : 0.7);
      c.setLineDash(Math.abs(off) <= settled ? [] : off > 0 ? [9, 5] : [2, 3]);
      c.beginPath();
      c.moveTo(...this.toScreen(x, y));
      c.lineTo(...this.toScreen(u, v));
      if (chosen) c.lineWidth += 4;
      c.stroke();
      const trouble = frame.now && this.trouble ? this.trouble(i, j) : "";
      const middle = this.toScreen((x + u) / 2, (y + v) / 2);
      if (trouble && (chosen || distance * this.scale > SAID_PX)) this.said(trouble, middle);
      else if (trouble) this.dot(middle);
    });
    c.setLineDash([]);
  }

  // What is wrong with a link, at its middle.
  said(text, [px, py]) {
    const { c } = this;
    c.font = "11px system-ui, sans-serif";
    c.textAlign = "center";
    c.setLineDash([]);
    c.lineWidth = 3;
    c.strokeStyle = this.theme.page;
    c.strokeText(text, px, py + 4);
    c.fillStyle = this.theme.bad;
    c.fillText(text, px, py + 4);
    c.textAlign = "start";
  }

  dot([px, py]) {
    const { c } = this;
    c.fillStyle = this.theme.bad;
    c.beginPath();
    c.arc(px, py, 3, 0, 2 * Math.PI);
    c.fill();
  }

  robots(frame) {
    const { c, source } = this;
    const { at, columns, scene } = source;
    const row = frame.row;
    this.drawn = scene.robots.map((_, index) => {
      const [x, y] = [row[index * columns + at.x], row[index * columns + at.y]];
      return Number.isNaN(x) ? null : this.toScreen(x, y);
    });
    const names = [];
    const safe = (scene.safe_m / 2) * this.scale;
    scene.robots.forEach((robot, index) => {
      const place = this.drawn[index];
      const from = index * columns;
      const [, state] = source.state(index, frame.t);
      if (this.show.places) this.slot(row[from + at.place_x], row[from + at.place_y], place);
      if (!place) {
        const last = frame.now && source.last && source.last.get(index);
        if (last) names.push(this.seenLast(robot, last));
        return;
      }
      const [px, py] = place;
      if (safe > 6) {
        c.strokeStyle = this.theme.soft;
        c.globalAlpha = 0.5;
        c.lineWidth = 1;
        c.beginPath();
        c.arc(px, py, safe, 0, 2 * Math.PI);
        c.stroke();
        c.globalAlpha = 1;
      }
      if (this.show.forces) this.arrows(row, from, place);
      this.body(robot, row[from + at.heading], place, state, index === this.chosen);
      const isUsual = !state || state === "running";
      const body = this.extent(robot, row[from + at.heading], place);
      const name = { texts: [...(isUsual ? [] : [`${robot.id} ${state}`]), `${robot.id}`], place, body };
      if (index === this.chosen) names.unshift(name);
      else names.push(name);
    });
    this.labels(names);
  }

  // A body that is not heard of any more, where it was last. Gives its label.
  seenLast(robot, { x, y, heading, at }) {
    const { c } = this;
    const place = this.toScreen(x, y);
    c.globalAlpha = 0.45;
    this.body(robot, heading, place, "fault", false);
    c.globalAlpha = 1;
    const ago = ((performance.now() - at) / 1000).toFixed(0);
    const body = this.extent(robot, heading, place);
    return { texts: [`${robot.id} seen ${ago} s ago`, `${robot.id}`], place, body };
  }

  // Names at their robots, each where it lies on none of those before: else shorter, or on the other side, or
  // not at all.
  labels(names) {
    const { c } = this;
    const taken = names.flatMap(({ place: [x, y], body: { x: u, y: v, size } }) => [
      [x - 5, y - 5, x + 5, y + 5], [u - size, v - size, u + size, v + size],
    ]);
    const isFree = ([x0, y0, x1, y1]) => x0 >= 0 && x1 <= this.width && !taken.some(
      ([u0, v0, u1, v1]) => x0 < u1 && u0 < x1 && y0 < v1 && v0 < y1,
    );
    c.font = "12px system-ui, sans-serif";
    for (const { texts, place: [px, py] } of names) {
      const found = texts.flatMap((text) => {
        const long = c.measureText(text).width;
        return [[px + 6, py - 7], [px - 6 - long, py - 7], [px + 6, py + 16]]
          .map(([x, y]) => ({ text, x, y, box: [x, y - LINE_PX + 3, x + long, y + 3] }));
      }).find(({ box }) => isFree(box));
      if (!found) continue;
      taken.push(found.box);
      this.label(found);
    }
  }

  slot(x, y, robot) {
    if (Number.isNaN(x)) return;
    const { c } = this;
    const [px, py] = this.toScreen(x, y);
    c.strokeStyle = this.theme.soft;
    c.lineWidth = 1;
    c.beginPath();
    c.moveTo(px - 4, py);
    c.lineTo(px + 4, py);
    c.moveTo(px, py - 4);
    c.lineTo(px, py + 4);
    if (robot && Math.hypot(px - robot[0], py - robot[1]) > 8) {
      c.moveTo(px, py);
      c.lineTo(...robot);
    }
    c.globalAlpha = 0.7;
    c.stroke();
    c.globalAlpha = 1;
  }

  arrows(row, from, [px, py]) {
    const { at } = this.source;
    for (const kind of ["navigation", "constraint"]) {
      const [fx, fy] = [row[from + at[`${kind}_x`]], row[from + at[`${kind}_y`]]];
      const length = Math.min(Math.hypot(fx, fy) * FORCE_PX, FORCE_PX_MAX);
      if (!(length > 8)) continue;
      this.arrow(px, py, Math.atan2(-fy, fx), length, COLORS[kind], kind === "constraint");
    }
  }

  arrow(px, py, angle, length, color, dashed) {
    const { c } = this;
    c.save();
    c.translate(px, py);
    c.rotate(angle);
    c.strokeStyle = c.fillStyle = color;
    c.lineWidth = 2;
    c.setLineDash(dashed ? [5, 3] : []);
    c.beginPath();
    c.moveTo(0, 0);
    c.lineTo(length - 6, 0);
    c.stroke();
    c.beginPath();
    c.moveTo(length, 0);
    c.lineTo(length - 8, 4);
    c.lineTo(length - 8, -4);
    c.fill();
    c.restore();
  }

  // Middle and size of a body on the screen. A hand point behind the axle has the body before it.
  extent(robot, heading, [px, py]) {
    const size = Math.max(7, Math.min(Math.abs(robot.hand_m) * this.scale, 40));
    const back = Math.max(Math.abs(robot.hand_m) * this.scale, size) * (robot.hand_m < 0 ? -1 : 1);
    const angle = Number.isNaN(heading) ? 0 : heading;
    return { x: px - back * Math.cos(angle), y: py + back * Math.sin(angle), size };
  }

  // A robot: its hand point, a dot, and behind it the body, which points where it heads. Its state is its shape:
  // a cross is in fault, a ring in trouble, a square at rest, what is hollow does not drive yet.
  body(robot, heading, [px, py], state, chosen) {
    const { c } = this;
    const { x, y, size } = this.extent(robot, heading, [px, py]);
    const look = this.source.scene.looks[state];
    const color = { failed: this.theme.bad, troubled: this.theme.warn }[look] || this.theme.robot;
    c.save();
    c.translate(x, y);
    c.rotate(-(Number.isNaN(heading) ? 0 : heading));
    c.fillStyle = c.strokeStyle = color;
    c.lineWidth = 2;
    c.beginPath();
    if (look === "rests") c.rect(-size * 0.55, -size * 0.55, size * 1.1, size * 1.1);
    else {
      c.moveTo(size * 0.9, 0);
      c.lineTo(-size * 0.7, size * 0.65);
      c.lineTo(-size * 0.4, 0);
      c.lineTo(-size * 0.7, -size * 0.65);
      c.closePath();
    }
    if (look === "unready") c.stroke();
    else c.fill();
    if (look === "failed") {
      c.strokeStyle = this.theme.bad;
      c.beginPath();
      c.moveTo(-size, -size);
      c.lineTo(size, size);
      c.moveTo(-size, size);
      c.lineTo(size, -size);
      c.stroke();
    } else if (look === "troubled") {
      c.beginPath();
      c.arc(0, 0, size * 1.15, 0, 2 * Math.PI);
      c.stroke();
    }
    if (chosen) {
      c.strokeStyle = this.theme.ink;
      c.setLineDash([3, 3]);
      c.beginPath();
      c.arc(0, 0, size * 1.5, 0, 2 * Math.PI);
      c.stroke();
    }
    c.restore();
    c.fillStyle = this.theme.ink;
    c.beginPath();
    c.arc(px, py, 2.2, 0, 2 * Math.PI);
    c.fill();
  }

  label({ text, x, y }) {
    const { c } = this;
    c.lineWidth = 3;
    c.strokeStyle = this.theme.page;
    c.strokeText(text, x, y);
    c.fillStyle = this.theme.ink;
    c.fillText(text, x, y);
  }
}
