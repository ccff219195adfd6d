// Curves over the whole run, each in a canvas of its own: a click goes to that moment.
import { COLORS } from "handfast/drawing.js";

const LEFT = 4;
const TOP = 16;

// What is drawn: heading, lines (each [numbers, colour, dash]), and a line that should not be crossed.
export function curvesOf(scene) {
  const { series, safe_m } = scene;
  const near = {
    title: "nearest two robots (m)", lines: [[series.nearest, COLORS.navigation, []]],
    limit: safe_m, limitText: "safe", zero: true,
  };
  const distances = series.edges.length
    ? { title: "distances of edges (m)", lines: series.edges.flatMap(({ low, high }) => [
      [low, COLORS.holds, []], [high, COLORS.holds, []],
    ]), limit: safe_m, limitText: "safe" }
    : { title: "worst edge is off by (m)", lines: [[series.error, COLORS.off, []]], zero: true };
  return [
    near,
    distances,
    { title: "farthest from its place (m)", lines: [[series.tracking, COLORS.bad, []]], zero: true },
    { title: "longest tick (µs)", lines: [[series.tick, COLORS.constraint, []]], zero: true },
    { title: "oldest message (ms)", lines: [[series.age, COLORS.off, []]], zero: true },
  ].filter((curve) => scene.live || curve.lines.some(([values]) => values.some((value) => value !== null)));
}

export class Curves {
  constructor(parent, scene, onSeek) {
    this.scene = scene;
    this.curves = curvesOf(scene).map((curve, number) => {
      const canvas = document.createElement("canvas");
      canvas.setAttribute("aria-label", curve.title);
      canvas.addEventListener("click", (event) => {
        onSeek(((event.offsetX - LEFT) / (canvas.clientWidth - 2 * LEFT)) * scene.end_s);
      });
      parent.append(canvas);
      return { ...curve, number, canvas, ...range(curve) };
    });
  }

  draw(t) {
    for (const curve of this.curves) this.drawOne(curve, t);
  }

  drawOne(curve, t) {
    const { canvas } = curve;
    const { end_s, live, series } = this.scene;
    const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
    const key = [canvas.clientWidth, window.devicePixelRatio, isDark, series.version, end_s].join(" ");
    if (curve.key !== key) {
      curve.key = key;
      if (live) {
        curve.lines = curvesOf(this.scene)[curve.number].lines; // they have grown
        Object.assign(curve, range(curve));
      }
      curve.picture = this.picture(curve);
    }
    const c = canvas.getContext("2d");
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.clearRect(0, 0, canvas.width, canvas.height);
    c.drawImage(curve.picture, 0, 0);
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth - 2 * LEFT;
    const x = (LEFT + (this.scene.end_s ? t / this.scene.end_s : 0) * width) * ratio;
    c.strokeStyle = color("accent");
    c.lineWidth = ratio;
    c.beginPath();
    c.moveTo(x, TOP * ratio);
    c.lineTo(x, canvas.height);
    c.stroke();
    const times = this.scene.series.t;
    let bin = times.length - 1;
    while (bin > 0 && times[bin] > t) bin -= 1;
    const here = curve.lines.map(([values]) => values[bin]).filter((value) => value !== null);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = color("soft");
    c.textAlign = "right";
    if (here.length) {
      const [low, high] = [Math.min(...here), Math.max(...here)];
      c.fillText(high - low > 1e-9 ? `${short(low)} to ${short(high)}` : short(high), canvas.clientWidth - LEFT, 11);
    }
    c.textAlign = "left";
  }

  // All of a curve but the moment, drawn once for each size.
  picture(curve) {
    const { canvas } = curve;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const picture = document.createElement("canvas");
    picture.width = Math.max(1, canvas.width);
    picture.height = Math.max(1, canvas.height);
    const c = picture.getContext("2d");
    c.scale(ratio, ratio);
    const end = this.scene.end_s || 1;
    const x = (t) => LEFT + (t / end) * (width - 2 * LEFT);
    const y = (value) => height - 3 - ((value - curve.low) / (curve.high - curve.low)) * (height - TOP - 5);
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = color("ink");
    c.fillText(curve.title, LEFT, 11);
    c.strokeStyle = color("line");
    c.strokeRect(LEFT, TOP, width - 2 * LEFT, height - TOP - 1);
    if (curve.limit !== undefined) {
      c.strokeStyle = color("bad");
      c.setLineDash([5, 3]);
      c.beginPath();
      c.moveTo(LEFT, y(curve.limit));
      c.lineTo(width - LEFT, y(curve.limit));
      c.stroke();
      c.setLineDash([]);
    }
    const times = this.scene.series.t;
    for (const [values, stroke] of curve.lines) {
      c.strokeStyle = stroke;
      c.lineWidth = 1.2;
      c.beginPath();
      let drawing = false;
      values.forEach((value, index) => {
        if (value === null) return (drawing = false);
        if (drawing) c.lineTo(x(times[index]), y(value));
        else c.moveTo(x(times[index]), y(value));
        return (drawing = true);
      });
      c.stroke();
    }
    if (curve.limit !== undefined) {
      c.textAlign = "right";
      c.lineWidth = 3;
      c.strokeStyle = color("card");
      c.strokeText(curve.limitText, width - LEFT - 3, y(curve.limit) - 2);
      c.fillStyle = color("bad");
      c.fillText(curve.limitText, width - LEFT - 3, y(curve.limit) - 2);
    }
    return picture;
  }
}

function range({ lines, limit, zero }) {
  let [low, high] = zero ? [0, -Infinity] : [Infinity, -Infinity];
  for (const [values] of lines) {
    for (const value of values) {
      if (value === null) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  if (limit !== undefined) {
    low = Math.min(low, limit);
    high = Math.max(high, limit);
  }
  if (!Number.isFinite(low)) low = 0;
  if (!Number.isFinite(high)) high = low + 1; // nothing is known yet
  const room = (high - low || 1) * 0.05;
  return { low: zero ? low : low - room, high: high + room };
}

function color(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function short(value) {
  return Math.abs(value) >= 100 ? value.toFixed(0) : Math.abs(value) < 1e-4 ? "0" : value.toPrecision(3);
}
