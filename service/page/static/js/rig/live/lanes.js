// Lanes of the muscles that contract most now, over the last seconds: time runs out at the left.

import { h, setText, show } from "../../dom.js";
import { plain } from "../../words.js";
import { FULL, HELD, PULL } from "../lanes.js";

const WINDOW_S = 10;
const COLUMNS = 300;
const LANES = 12;
const LEAST = 0.03; // of a muscle that gets a lane
const LASTS = 0.995; // of a muscle's strength is left a frame later

/** Rolling lanes of a session's muscles. */
export class LiveLanes {
  #names;
  #strengths;
  #lanes = [];
  #list = h("ul", { class: "lanes pulls rolling", "aria-label": "Who contracts now" });
  #column = null;

  constructor(names) {
    this.#names = names;
    this.#strengths = new Float32Array(names.length);
    const key = h("span", { class: "lane-swatch" });
    key.style.background = HELD;
    this.element = h("div", { class: "stack lanes-box" },
      h("p", { class: "fine" }, `Who contracts, in % of the fibres' length, over the last ${WINDOW_S} s. `, key, "held: the frame told nothing."),
      this.#list);
  }

  /** Draw a frame: `contractions` of all muscles at a time in s of this machine's clock. */
  add(contractions, isHeld, seconds) {
    this.#choose(contractions);
    const column = Math.floor((COLUMNS * seconds) / WINDOW_S);
    const steps = this.#column === null ? 0 : Math.min(COLUMNS, column - this.#column);
    this.#column = column;
    for (const lane of this.#lanes) {
      const value = contractions[lane.muscle];
      lane.paint(steps, isHeld ? HELD : `rgba(${PULL}, ${share(value)})`);
      setText(lane.figure, Number.isFinite(value) ? `${Math.round(100 * value)} %` : "–");
    }
  }

  /** Give the muscles that were strongest of late a lane each; one that has a lane keeps it while it is near. */
  #choose(contractions) {
    for (let m = 0; m < contractions.length; m++) {
      const now = Number.isFinite(contractions[m]) ? contractions[m] : 0;
      this.#strengths[m] = Math.max(now, this.#strengths[m] * LASTS);
    }
    const shown = new Set(this.#lanes.map(({ muscle }) => muscle));
    const strongest = [...this.#strengths.keys()]
      .filter((m) => this.#strengths[m] >= LEAST)
      .sort((a, b) => this.#strengths[b] - this.#strengths[a]);
    const kept = new Set(strongest.slice(0, 2 * LANES).filter((m) => shown.has(m)));
    const wanted = new Set(strongest.slice(0, LANES));
    const before = this.#lanes.length;
    this.#lanes = this.#lanes.filter(({ muscle }) => kept.has(muscle));
    const added = [...wanted].filter((m) => !kept.has(m)).slice(0, LANES - this.#lanes.length);
    if (!added.length && before === this.#lanes.length) return;
    this.#lanes.push(...added.map((m) => new Lane(m, plain(this.#names[m]))));
    show(this.#list, this.#lanes.map(({ element }) => element));
  }
}

class Lane {
  #canvas = h("canvas", { width: COLUMNS, height: 1, "aria-hidden": "true" });
  #pen = this.#canvas.getContext("2d");

  constructor(muscle, name) {
    this.muscle = muscle;
    this.figure = h("span", { class: "figure" });
    this.element = h("li", {},
      h("span", { class: "lane-name", title: name }, name),
      h("span", { class: "lane" }, this.#canvas),
      this.figure);
  }

  /** Move what was drawn by columns to the left and fill them. */
  paint(steps, colour) {
    const from = Math.max(1, steps);
    if (steps) {
      this.#pen.globalCompositeOperation = "copy";
      this.#pen.drawImage(this.#canvas, -steps, 0);
      this.#pen.globalCompositeOperation = "source-over";
    }
    this.#pen.clearRect(COLUMNS - from, 0, from, 1);
    this.#pen.fillStyle = colour;
    this.#pen.fillRect(COLUMNS - from, 0, from, 1);
  }
}

function share(contraction) {
  return Number.isFinite(contraction) ? Math.max(0, Math.min(contraction / FULL, 1)).toFixed(2) : "0";
}
