// The page: what it shows, a recording or a running fleet.
import { Player } from "handfast/player.js";
import { Recorded } from "handfast/recorded.js";

const FORMAT = 1; // as deploy/playback/scene.py

async function fetched(address, kind) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`${address}: the server answers ${answer.status}`);
  return kind === "json" ? answer.json() : new Float32Array(await answer.arrayBuffer());
}

function checked(scene) {
  if (scene.format !== FORMAT) throw new Error("this page is of another version than what it is given: reload it");
  return scene;
}

// A recording that is inside the page.
function inside() {
  const text = document.getElementById("overview").textContent;
  const rows = new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  return new Recorded(checked(JSON.parse(document.getElementById("scene").textContent)), rows, null);
}

async function recorded() {
  const scene = checked(await fetched("scene", "json"));
  return new Recorded(scene, await fetched("overview", "rows"), (number) => fetched(`piece/${number}`, "rows"));
}

async function begin() {
  const shows = document.getElementById("main")?.dataset.shows;
  try {
    if (shows === "live") {
      const { connected } = await import("handfast/live.js");
      window.handfast = await connected(checked);
    } else window.handfast = new Player(shows ? await recorded() : inside());
  } catch (error) {
    const place = document.getElementById("problem");
    place.textContent = `This cannot be shown: ${error.message}`;
    place.hidden = false;
  }
}

begin();
