// Lanes of a fitted take: what became of every label, and when each muscle was held.

import { h, setText, show } from "../dom.js";
import { count, plain } from "../words.js";
import { STATES } from "./marker_solids.js";

const HELD = "#c98a12";
const MOST_NAMED = 4;

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

  #row({ name, words, canvas, marked, frames }) {
    const share = Math.round((100 * marked) / frames);
    canvas.addEventListener("click", (event) => {
      const { left, width } = canvas.getBoundingClientRect();
      this.#go(Math.max(0, Math.min(frames - 1, Math.floor((frames * (event.clientX - left)) / width))));
    });
    return h("li", {},
      h("span", { class: "lane-name", title: name }, name),
      h("span", { class: "lane" }, canvas),
      h("span", { class: "figure" }, marked ? `${share || "<1"} %` : "", h("span", { class: "unseen" }, words)));
  }
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
