// What the face does: sliders of expressions and of muscles.

import { h, show } from "../dom.js";
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
  return { expressions: positive(expressions), controls: new Map(), take: null };
}

function positive(values) {
  return new Map([...values].filter(([, value]) => value > 0));
}

/** The muscles: their sliders where the rig has an approximation, else their names. */
export class MusclePanel {
  #face;
  #change;
  #preview = null;
  #rows = new Map();
  #list = h("ol", { class: "sliders with-error" });
  #head = h("div", { class: "stack" });
  #bothSides = h("input", { type: "checkbox", checked: true });
  #values = new Map();

  constructor(face, change) {
    this.#face = face;
    this.#change = change;
    const search = h("input", {
      type: "search", placeholder: "Find a muscle", "aria-label": "Find a muscle",
      oninput: () => this.#filter(search.value.trim().toLowerCase()),
    });
    this.element = h("div", { class: "pose" }, this.#head, search, this.#list);
    this.setMissing("Loading the approximation …");
  }

  /** Have no sliders, for a reason. */
  setMissing(why) {
    show(this.#head, h("p", { class: "fine" }, why));
    this.#rows = new Map(this.#face.muscles.map((name) => [name, this.#row(name, plain(name), null)]));
    this.#fill();
  }

  /** Have sliders by an approximation. */
  setPreview(preview) {
    this.#preview = preview;
    const presets = h("select", {
      "aria-label": "Set the muscles as in an expression",
      onchange: () => {
        const { values } = preview.presets[presets.selectedIndex - 1];
        this.#pose(new Map(values.map((value, i) => [preview.controls[i].name, Number(value.toFixed(2))])));
        presets.selectedIndex = 0;
      },
    }, h("option", {}, "As in …"), preview.presets.map(({ name }) => h("option", {}, plain(name))));
    show(this.#head,
      h("p", { class: "fine" }, `The skin follows the muscles by the solver's physics, in an ${preview.errorInWords}.`),
      h("div", { class: "row" }, presets,
        h("button", { type: "button", onclick: () => this.#pose(new Map()) }, "Relax all"),
        h("label", { class: "check-field" }, this.#bothSides, "both sides together")));
    this.#rows = new Map(preview.controls.map((control, number) => [control.name, this.#row(control.muscle, control.title, number)]));
    this.#fill();
  }

  /** Show a state. */
  show(state) {
    this.#values = state.controls;
    for (const [name, row] of this.#rows) {
      if (this.#preview) row.slider.set(state.controls.get(name) ?? 0);
      row.choose(row.muscle !== null && row.muscle === state.muscle);
    }
  }

  #row(muscle, title, number) {
    const chosen = () => this.#change((state) => (
      state.muscle === muscle ? { muscle: null } : { muscle, inside: true }
    ));
    if (number === null) {
      const button = h("button", { type: "button", class: "plain name", onclick: chosen }, title);
      return {
        title, muscle, element: h("li", {}, button),
        choose: (isChosen) => button.setAttribute("aria-pressed", String(isChosen)),
      };
    }
    const error = this.#preview.error.per_control?.[number];
    const slider = new Slider({
      name: title,
      hint: muscle ? "Show this muscle" : "",
      figures: [Number.isFinite(error) ? `± ${error.toFixed(2)}` : ""],
      moved: (value) => this.#move(number, value),
      chosen: muscle ? chosen : () => {},
    });
    return { title, muscle, slider, element: slider.element, choose: (isChosen) => muscle && slider.setChosen(isChosen) };
  }

  #move(number, value) {
    const values = new Map(this.#values).set(this.#preview.controls[number].name, value);
    const partner = this.#bothSides.checked ? this.#preview.partner(number) : -1;
    if (partner >= 0) values.set(this.#preview.controls[partner].name, value);
    this.#pose(values);
  }

  #pose(controls) {
    this.#change({ controls: positive(controls), expressions: new Map(), take: null });
  }

  #fill() {
    show(this.#list, [...this.#rows.values()].map((row) => row.element));
  }

  #filter(words) {
    for (const row of this.#rows.values()) row.element.hidden = !row.title.toLowerCase().includes(words);
  }
}
