// Lanes of a fitted take: what became of every label, when each muscle was held, and who contracts.

import { h, setText, show } from "../dom.js";
import { count, plain } from "../words.js";
import { STATES } from "./marker_solids.js";

export const HELD = "#c98a12";
const MOST_NAMED = 4;
export const PULL = "33, 102, 172";
export const FULL = 0.4; // contraction that has the full colour, as a slider at 1
const MOST_PULLS = 12;
const LEAST_PULL = 0.05; // of a muscle at its most that has a lane

/** Lanes over time; `go(frame)` is called where one is clicked. */
export class Lanes {
  #take = null;
  #go;
  #now = h("p", { class: "fine", "aria-live": "off" });
  #labels = h("ul", { class: "lanes", "aria-label": "Labels" });
  #muscles = h("ul", { class: "lanes", "aria-label": "Held muscles" });
  #rest = h("p", { class: "fine" });

  constructor(go) {
    this.#go = go;
    const keys = [...Object.values(STATES).slice(1), { title: "held", colour: HELD }];
    this.element = h("div", { class: "stack lanes-box" },
      this.#now,
      h("ul", { class: "lane-keys" }, keys.map(({ title, colour }) => h("li", {}, swatch(colour), title))),
      this.#labels, this.#muscles, this.#rest);
  }

  /** Show the frame of a take (`MarkerTake`). */
  show(take, frame) {
    if (this.#take !== take) this.#draw(take);
    this.element.style.setProperty("--at", `${(100 * (frame + 0.5)) / take.frames}%`);
    setText(this.#now, inWords(take, frame));
  }

  #draw(take) {
    this.#take = take;
    const labels = take.labels.map((name, k) => lane(take, name, (frame) => {
      const key = take.state(frame, k);
      return key === "seen" ? null : STATES[key];
    }));
    const muscles = take.muscles
      .map((name, m) => lane(take, plain(name), (frame) => (take.isHeld(frame, m) ? { title: "held", colour: HELD } : null)));
    const [held, free] = [muscles.filter(({ marked }) => marked), muscles.filter(({ marked }) => !marked)];
    show(this.#labels, worstFirst(labels).map((each) => this.#row(each)));
    show(this.#muscles, worstFirst(held).map((each) => this.#row(each)));
    setText(this.#rest, free.length ? `${count(free.length, "muscle is", "muscles are")} never held.` : "");
  }

  #row(lane) {
    const share = Math.round((100 * lane.marked) / lane.frames);
    return laneRow(lane, this.#go, [lane.marked ? `${share || "<1"} %` : "", h("span", { class: "unseen" }, lane.words)]);
  }
}

/** Lanes of the muscles that contract most in a take (`Take`); `go(frame)` is called where one is clicked. */
export class ContractionLanes {
  #of = null;
  #go;
  #list = h("ul", { class: "lanes pulls", "aria-label": "Who contracts" });

  constructor(go) {
    this.#go = go;
    this.element = h("div", { class: "stack lanes-box" },
      h("p", { class: "fine" }, "Who contracts: the darker, the more; at most, in % of the fibres' length."), this.#list);
  }

  /** Show the frame of a take. */
  show(take, frame) {
    if (this.#of !== take) {
      this.#of = take;
      show(this.#list, mostPulling(take).map(([m, most]) => laneRow(pullLane(take, m), this.#go, `${Math.round(100 * most)} %`)));
    }
    this.element.style.setProperty("--at", `${(100 * (frame + 0.5)) / take.frames}%`);
  }
}

/** Return the muscles that contract most, each as its number and its most, the strongest first. */
function mostPulling({ frames, contractions }) {
  const most = contractions.muscles.map(() => -Infinity);
  for (let frame = 0; frame < frames; frame++) {
    for (const [m, value] of contractions.at(frame).entries()) if (value > most[m]) most[m] = value;
  }
  return [...most.entries()].filter(([, value]) => value >= LEAST_PULL).sort((a, b) => b[1] - a[1]).slice(0, MOST_PULLS);
}

function pullLane(take, m) {
  return lane(take, plain(take.contractions.muscles[m]), (frame) => {
    const share = Math.min(take.contractions.at(frame)[m] / FULL, 1);
    return share > 0 ? { title: "contracts", colour: `rgba(${PULL}, ${share.toFixed(2)})` } : null;
  });
}

/** Return a lane's row with what stands behind it; a click on it calls `go(frame)`. */
function laneRow({ name, canvas, frames }, go, behind) {
  canvas.addEventListener("click", (event) => {
    const { left, width } = canvas.getBoundingClientRect();
    go(Math.max(0, Math.min(frames - 1, Math.floor((frames * (event.clientX - left)) / width))));
  });
  return h("li", {},
    h("span", { class: "lane-name", title: name }, name),
    h("span", { class: "lane" }, canvas),
    h("span", { class: "figure" }, behind));
}

/** Return a lane's canvas, a pixel a frame, with what is in it; `markOf(frame)` has title and colour, or is null. */
function lane(take, name, markOf) {
  const { frames } = take;
  const canvas = h("canvas", { width: frames, height: 1, "aria-hidden": "true" });
  const pen = canvas.getContext("2d");
  const counts = new Map();
  let marked = 0;
  for (let frame = 0; frame < frames; frame++) {
    const mark = markOf(frame);
    if (!mark) continue;
    marked++;
    counts.set(mark.title, (counts.get(mark.title) ?? 0) + 1);
    pen.fillStyle = mark.colour;
    pen.fillRect(frame, 0, 1, 1);
  }
  const words = [...counts].map(([title, number]) => ` ${title} in ${count(number, "frame")}`).join(",");
  return { name, words, canvas, marked, frames };
}

function worstFirst(lanes) {
  return lanes.toSorted((a, b) => b.marked - a.marked);
}

function swatch(colour) {
  const element = h("span", { class: "lane-swatch" });
  element.style.background = colour;
  return element;
}

/** Say what is with the markers and muscles in a frame. */
function inWords(take, frame) {
  const parts = [];
  for (const [key, { title }] of Object.entries(STATES)) {
    const names = take.labels.filter((_, k) => take.state(frame, k) === key);
    if (key === "seen") parts.push(`${names.length} of ${take.labels.length} markers count`);
    else if (names.length) parts.push(`${title}: ${some(names)}`);
  }
  const held = take.muscles.filter((_, m) => take.isHeld(frame, m)).length;
  if (held) parts.push(`${count(held, "muscle")} held`);
  const status = take.status[frame];
  return `${status === "fitted" ? "" : `${plain(status)}. `}${parts.join("; ")}.`;
}

function some(names) {
  const more = names.length - MOST_NAMED;
  return names.slice(0, MOST_NAMED).join(", ") + (more > 0 ? ` and ${more} more` : "");
}
