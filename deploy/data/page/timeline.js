// The line of time with its marks: a click or a drag goes to that moment, arrow keys step.
const PAD = 8;
const SHAPES = { violation: "bad", fault: "warn", order: "accent", state: "soft", vehicle: "soft" };

export class Timeline {
  constructor(canvas, scene, onSeek) {
    Object.assign(this, { canvas, scene });
    canvas.setAttribute("aria-valuemax", scene.end_s.toFixed(2));
    const seek = (event) => onSeek(this.timeAt(event.offsetX));
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.dragging = true;
      seek(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (this.dragging) return seek(event);
      const near = this.near(event.offsetX);
      canvas.title = near ? `${near.t_s.toFixed(1)} s: ${near.text}` : "";
    });
    const end = () => (this.dragging = false);
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
  }

  get room() {
    return Math.max(1, this.canvas.clientWidth - 2 * PAD);
  }

  x(t) {
    return PAD + (this.scene.end_s ? Math.min(Math.max(t / this.scene.end_s, 0), 1) : 0) * this.room;
  }

  timeAt(px) {
    return Math.min(Math.max((px - PAD) / this.room, 0), 1) * this.scene.end_s;
  }

  near(px) {
    return this.scene.marks.find((mark) => Math.abs(this.x(mark.t_s) - px) < 4);
  }

  draw(t) {
    const { canvas, scene } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(`--${name}`).trim();
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    const middle = height - 10;
    c.fillStyle = color("line");
    c.fillRect(PAD, middle - 2, this.room, 4);
    c.fillStyle = color("accent");
    c.fillRect(PAD, middle - 2, this.x(t) - PAD, 4);
    for (const mark of scene.marks) {
      const x = this.x(mark.t_s);
      c.fillStyle = c.strokeStyle = color(SHAPES[mark.kind]);
      if (mark.end_s !== null) {
        c.globalAlpha = 0.3;
        c.fillRect(x, 3, Math.max(this.x(mark.end_s) - x, 1), 8);
        c.globalAlpha = 1;
      }
      c.beginPath();
      if (mark.kind === "violation") {
        c.moveTo(x - 4, 2);
        c.lineTo(x + 4, 2);
        c.lineTo(x, 12);
        c.fill();
      } else if (mark.kind === "order") {
        c.fillRect(x - 1, 2, 2, height - 12);
      } else {
        c.fillRect(x - 0.5, 4, 1, 10);
      }
    }
    c.fillStyle = color("accent");
    c.beginPath();
    c.arc(this.x(t), middle, 6, 0, 2 * Math.PI);
    c.fill();
    canvas.setAttribute("aria-valuenow", t.toFixed(2));
    canvas.setAttribute("aria-valuetext", `${t.toFixed(2)} seconds`);
  }
}
