// Plays what a source gives: its clock, its keys, and what is drawn when.
import { Curves } from "handfast/curves.js";
import { Events, Robots } from "handfast/panels.js";
import { Plan } from "handfast/plan.js";
import { Timeline } from "handfast/timeline.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 20, 50];
const PANELS_MS = 100; // tables change so often at most
const dark = matchMedia("(prefers-color-scheme: dark)");
const find = (id) => document.getElementById(id);

export function problem(text) {
  if (find("problem").textContent !== text) find("problem").textContent = text;
  find("problem").hidden = !text;
}

export class Player {
  constructor(source) {
    const { scene } = source;
    Object.assign(this, { source, scene, t: 0, speed: 1, playing: false, toldAt: 0, saidAt: 0, chosen: null });
    this.link = null;
    this.follows = Boolean(source.live); // what is now, as long as nobody looks back
    const seek = (t, mark) => this.seek(t, mark);
    this.plan = new Plan(find("plan"), source, (index, link) => this.choose(index, link));
    this.robots = new Robots(find("robots"), source, (index) => this.choose(index));
    this.curves = new Curves(find("charts"), scene, seek);
    this.events = new Events(find("events"), scene, seek);
    this.timeline = new Timeline(find("line"), scene, seek);
    this.remembers();
    this.about();
    this.controls();
    this.buttons();
    if (window.top !== window) find("link").hidden = true; // within another page it has no address
    const named = /[#&]t=([0-9.]+)/.exec(location.hash);
    if (named || !source.live) this.seek(named ? Number(named[1]) : 0);
    window.addEventListener("hashchange", () => {
      const moment = /[#&]t=([0-9.]+)/.exec(location.hash);
      if (moment) this.seek(Number(moment[1]));
    });
    requestAnimationFrame((now) => this.step(now));
  }

  about() {
    const { scene } = this;
    document.title = `${scene.fleet} – handfast`;
    find("title").textContent = scene.fleet;
    const how = this.source.live ? this.source.how(this.t, this.follows) : scene.mode === "simulate" ? "in virtual time" : "recorded";
    const about = `${scene.robots.length} robots, ${scene.law}, ${how}`;
    if (find("about").textContent !== about) find("about").textContent = about;
    find("now").hidden = !this.source.live;
    if (this.source.live) return;
    const verdict = find("verdict");
    verdict.textContent = scene.verdict.passed ? "passed" : "failed";
    verdict.className = scene.verdict.passed ? "passed" : "failed";
    verdict.title = [...scene.verdict.reasons, ...scene.verdict.warnings].join("\n");
  }

  // A report that is opened from disk has no place of its own to keep anything in.
  remembers() {
    if (location.protocol === "file:" || window.top !== window) return;
    try {
      this.plan.recall();
    } catch {
      return; // a browser that keeps nothing
    }
    window.addEventListener("pagehide", () => this.plan.remember());
    for (const [name, on] of Object.entries({ ...this.plan.show, follow: this.plan.follow })) {
      find(name).setAttribute("aria-pressed", on);
    }
  }

  controls() {
    const speed = find("speed");
    for (const each of SPEEDS) speed.add(new Option(`${each} x`, each, each === 1, each === 1));
    speed.addEventListener("change", () => (this.speed = Number(speed.value)));
    const toggle = (name) => {
      this.plan.show[name] = !this.plan.show[name];
      find(name).setAttribute("aria-pressed", this.plan.show[name]);
    };
    const actions = {
      now: () => this.now(),
      play: () => this.play(this.follows ? false : !this.playing),
      back: () => this.tick(-1),
      on: () => this.tick(1),
      fit: () => {
        this.plan.fit(this.plan.auto && !this.plan.near);
        this.plan.auto = true;
      },
      follow: () => {
        this.plan.follow = !this.plan.follow;
        find("follow").setAttribute("aria-pressed", this.plan.follow);
      },
      "zoom-in": () => this.plan.zoom(1.3),
      "zoom-out": () => this.plan.zoom(1 / 1.3),
      trails: () => toggle("trails"),
      places: () => toggle("places"),
      forces: () => {
        toggle("forces");
        if (this.source.live) this.source.wantForces(this.plan.show.forces);
      },
      link: () => this.copyLink(),
    };
    for (const [id, act] of Object.entries(actions)) find(id).addEventListener("click", act);
    // One that was clicked does not keep the keyboard: space plays.
    document.addEventListener("click", ({ detail, target }) => detail && target.closest("button")?.blur());
    const keys = {
      " ": "play", ArrowLeft: "back", ArrowRight: "on", f: "fit", o: "follow", "+": "zoom-in", "-": "zoom-out",
      t: "trails", p: "places", v: "forces", l: "link",
    };
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (["SELECT", "INPUT"].includes(event.target.tagName)) return;
      if (event.key === "Home") this.seek(this.source.begin || 0);
      else if (event.key === "End") this.source.live ? this.now() : this.seek(this.source.end);
      else if (keys[event.key] && !(event.key === " " && event.target.tagName === "BUTTON")) actions[keys[event.key]]();
      else return;
      event.preventDefault();
    });
  }

  play(playing) {
    this.playing = playing;
    this.follows = false;
    if (playing && this.t >= this.source.end) this.seek(0);
    this.buttons();
  }

  // Goes back to what is now.
  now() {
    this.follows = true;
    this.playing = false;
    this.toldAt = 0;
    this.buttons();
  }

  buttons() {
    find("play").textContent = this.playing || this.follows ? "pause" : "play";
    document.body.classList.toggle("back", Boolean(this.source.live) && !this.follows);
    find("now").setAttribute("aria-pressed", this.follows);
  }

  tick(by) {
    this.play(false);
    const { rate } = this.source;
    this.seek((Math.round(this.t * rate) + by) / rate);
  }

  // A robot, or a link (places of two robots) of a running fleet; once more, or neither: nothing.
  choose(index, link = null) {
    this.chosen = this.plan.chosen = index === this.chosen ? null : index;
    const isLink = this.source.live && link && String(link) !== String(this.plan.link);
    this.plan.link = isLink ? link : null;
    this.link = isLink ? link.map((each) => this.scene.robots[each].id) : null;
    this.toldAt = 0;
  }

  legend() {
    let text = `grid ${Number(this.plan.step.toPrecision(2))} m`;
    if (this.source.live || this.scene.edges.length) text += "; edges: solid holds, dashed too long, dotted too short";
    if (this.plan.show.places) text += "; + place";
    if (this.plan.show.forces) text += "; forces: blue navigation, dashed pink constraint";
    if (find("scale").textContent !== text) find("scale").textContent = text;
    const next = this.plan.auto && !this.plan.near ? "fit robots" : "fit all";
    if (find("fit").textContent !== next) find("fit").textContent = next;
  }

  copyLink() {
    try {
      history.replaceState(null, "", `#t=${this.t.toFixed(3)}`);
    } catch {
      return; // within another page there is no address to copy
    }
    if (navigator.clipboard) navigator.clipboard.writeText(location.href).catch(() => {});
    find("link").textContent = "copied";
    setTimeout(() => (find("link").textContent = "link"), 1200);
  }

  seek(t, mark) {
    this.t = Math.min(Math.max(t, this.source.begin || 0), this.source.end);
    if (this.follows) this.follows = false;
    this.buttons();
    if (mark && mark.robots.length) {
      this.chosen = this.plan.chosen = this.scene.robots.findIndex((robot) => robot.id === mark.robots[0]);
    }
    this.toldAt = 0;
    this.load();
  }

  load() {
    this.source.want(this.t).then(
      () => problem(""),
      (error) => problem(`The server that gives this recording is gone: what is shown is coarse (${error.message})`),
    );
  }

  step(now) {
    const passed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
    this.last = now;
    if (this.playing && !this.timeline.dragging) {
      const before = Math.floor(this.t);
      this.t = Math.min(this.t + passed * this.speed, this.source.end);
      if (Math.floor(this.t) !== before) this.load();
      if (this.t >= this.source.end) {
        if (this.source.live) this.now();
        else this.play(false);
      }
    }
    if (this.follows) this.t = this.source.end;
    const frame = this.source.frame(this.follows ? null : this.t);
    requestAnimationFrame((next) => this.step(next));
    // What stands still is not drawn again: a page that nobody plays costs its computer nothing.
    const { clientWidth, clientHeight } = this.plan.canvas;
    const look = JSON.stringify([
      this.t, frame.exact, frame.number, this.chosen, this.plan.look(), dark.matches,
      clientWidth, clientHeight, window.devicePixelRatio,
    ]);
    if (look !== this.drawn) {
      this.drawn = look;
      this.plan.draw(frame);
      this.timeline.draw(this.t);
      find("time").textContent = this.source.timeText(this.t, this.follows);
      this.legend();
      document.body.dataset.exact = frame.exact;
    }
    if (this.source.live && now - this.saidAt >= PANELS_MS) {
      this.saidAt = now;
      this.about();
    }
    const { marks } = this.scene; // they grow while somebody looks back as well
    const news = `${look} ${marks.length} ${marks.order}`;
    if (news !== this.told && now - this.toldAt >= PANELS_MS) {
      this.told = news;
      this.toldAt = now;
      this.robots.show(frame, this.chosen);
      this.events.show(this.t);
      this.curves.draw(this.t);
      if (this.onTold) this.onTold(frame);
    }
    if (this.source.drawn) this.source.drawn();
  }
}
