// The formation by its handles: places are dragged, what comes of it is shown and checked, then it is ordered.
import { element } from "handfast/panels.js";

const HANDLE_PX = 9;
const ASK_MS = 250;

export class Reshape {
  constructor(player, source, controls) {
    Object.assign(this, { player, source, controls, active: false, moved: new Map(), said: "", fine: false, number: 0 });
    const { plan } = player;
    plan.over = (frame) => this.active && this.draw(frame);
    plan.grab = (px, py) => (this.active ? this.grab(px, py) : null);
  }

  toggle() {
    this.active = !this.active;
    this.moved.clear();
    this.said = "";
    this.fine = false;
    if (!this.active) return;
    const { width, height } = this.player.plan;
    const isSeen = ([x, y]) => x > 0 && y > 0 && x < width && y < height;
    if (![...this.places().values()].every((place) => isSeen(this.player.plan.toScreen(...place)))) this.player.plan.fit(true);
  }

  // Places that members have now, with what was dragged: id -> [x, y], m.
  places() {
    const { scene, row, columns, at, parts } = this.source;
    const found = new Map();
    scene.robots.forEach(({ id }, k) => {
      const [x, y] = [row[k * columns + at.place_x], row[k * columns + at.place_y]];
      if (Number.isNaN(x) || !parts.panel.members.includes(id)) return;
      const [dx, dy] = this.moved.get(id) || [0, 0];
      found.set(id, [x + dx, y + dy]);
    });
    return found;
  }

  grab(px, py) {
    const { plan } = this.player;
    let [found, least] = [null, 2 * HANDLE_PX];
    for (const [id, place] of this.places()) {
      const [x, y] = plan.toScreen(...place);
      const away = Math.hypot(x - px, y - py);
      if (away < least) [found, least] = [id, away];
    }
    if (found === null) return null;
    return (dx, dy) => {
      const [x, y] = this.moved.get(found) || [0, 0];
      this.moved.set(found, [x + dx, y + dy]);
      this.ask();
    };
  }

  offsets() {
    return Object.fromEntries([...this.moved].map(([id, by]) => [id, by]));
  }

  // Asks what would come of it, now and then while it is dragged.
  ask() {
    if (this.waits) return;
    this.waits = setTimeout(() => {
      this.waits = null;
      this.number += 1;
      this.said = "checking ...";
      this.fine = false;
      this.source.say({ preview: { number: this.number, by: this.offsets() } });
      this.controls.chosenKey = null;
    }, ASK_MS);
  }

  told({ number, text, fine }) {
    if (number !== this.number || !this.active) return;
    this.said = text;
    this.fine = fine;
    this.controls.chosenKey = null;
  }

  elements() {
    const order = element("button", "order it");
    order.disabled = !this.fine;
    order.addEventListener("click", () => {
      this.controls.order({ kind: "move", by: this.offsets() });
      this.toggle();
    });
    return [order, element("span", this.said || "drag the places, marked by rings", this.fine ? "good" : "soft")];
  }

  draw(frame) {
    const { plan } = this.player;
    const { c } = plan;
    const places = this.places();
    const ids = this.source.scene.robots.map(({ id }) => id);
    c.save();
    c.strokeStyle = plan.theme.accent;
    c.setLineDash([4, 4]);
    this.source.eachEdge(frame, (i, j) => {
      const [a, b] = [places.get(ids[i]), places.get(ids[j])];
      if (!a || !b) return;
      c.beginPath();
      c.moveTo(...plan.toScreen(...a));
      c.lineTo(...plan.toScreen(...b));
      c.stroke();
    });
    c.setLineDash([]);
    c.lineWidth = 2.5;
    for (const [id, place] of places) {
      c.beginPath();
      c.arc(...plan.toScreen(...place), HANDLE_PX, 0, 2 * Math.PI);
      c.fillStyle = plan.theme.card;
      c.globalAlpha = 0.6;
      c.fill();
      c.globalAlpha = 1;
      c.stroke();
      c.fillStyle = plan.theme.ink;
      c.font = "11px system-ui, sans-serif";
      c.textAlign = "center";
      const [px, py] = plan.toScreen(...place);
      c.fillText(String(id), px, py + 4);
    }
    c.restore();
  }
}
