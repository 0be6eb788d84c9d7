// The expressions: their sliders, with figures beside them.

import { h } from "../dom.js";
import { plain } from "../words.js";
import { Slider } from "./slider.js";

const KEYS = 9; // 1 to 9 choose an expression

/**
 * Expressions with their sliders: `rows` are names with three `figures` each, under `heads`, which
 * `explained` says more of. `change(patch)` takes a part of a state.
 */
export class ExpressionPanel {
  #rows;

  constructor({ rows, heads, explained, change }) {
    this.#rows = new Map(rows.map(({ name, figures }, k) => [name, new Slider({
      name: plain(name),
      hint: "Show this expression alone",
      key: k < KEYS ? String(k + 1) : null,
      figures,
      moved: (value) => change(pose(new Map(this.weights).set(name, value))),
      chosen: () => change(pose(new Map([[name, 1]]))),
    })]));
    this.weights = new Map();
    this.element = h("div", { class: "pose" },
      h("div", { class: "row" },
        h("button", { type: "button", onclick: () => change(pose(new Map())) }, "Neutral"),
        h("span", { class: "fine grow" }, explained)),
      h("ol", { class: "sliders with-figures" },
        h("li", { class: "slider heads", "aria-hidden": "true" }, h("span"), h("span"), h("span"),
          heads.map((text) => h("span", { class: "figure" }, text))),
        [...this.#rows.values()].map((row) => row.element)));
  }

  /** Show a state. */
  show(state) {
    this.weights = state.expressions;
    for (const [name, row] of this.#rows) row.set(state.expressions.get(name) ?? 0);
  }
}

/** Return the part of a state that poses the face by expressions. */
export function pose(expressions) {
  return { expressions: positive(expressions), controls: new Map(), take: null, live: null };
}

/** Return the values above zero. */
export function positive(values) {
  return new Map([...values].filter(([, value]) => value > 0));
}
