// The muscles: their sliders where the rig has an approximation, else their names.

import { h, setText, show } from "../dom.js";
import { plain } from "../words.js";
import { millimetres } from "./face.js";
import { positive } from "./pose_panel.js";
import { Slider } from "./slider.js";

const ERROR = "± mm: how far the skin of a slider alone is off the simulation.";
const FIBRES = "fibres: their length in the expression that is shown, by that at rest; below 100 % the muscle is short.";

/** Muscles and jaw; `change(patch)` takes a part of a state, or what a function makes of one. */
export class MusclePanel {
  #face;
  #change;
  #preview = null;
  #rows = new Map();
  #values = new Map();
  #head = h("div", { class: "stack" });
  #legend = h("p", { class: "fine" });
  #list = h("ol", { class: "sliders with-error" });
  #bothSides = h("input", { type: "checkbox", checked: true });

  constructor(face, change) {
    this.#face = face;
    this.#change = change;
    const search = h("input", {
      type: "search", placeholder: "Find a muscle", "aria-label": "Find a muscle",
      oninput: () => this.#filter(search.value.trim().toLowerCase()),
    });
    this.element = h("div", { class: "pose" }, this.#head, search, this.#legend, this.#list);
    this.setMissing(h("p", { class: "fine" }, "Loading the sliders …"));
  }

  /** Have no sliders; `instead` are elements or texts. */
  setMissing(...instead) {
    show(this.#head, instead);
    setText(this.#legend, FIBRES);
    this.#fill(["", "fibres"], this.#face.muscles.map((name) => [name, this.#plainRow(name)]));
  }

  /** Have sliders by an approximation. */
  setPreview(preview) {
    this.#preview = preview;
    const presets = h("select", {
      "aria-label": "Set the muscles as in an expression",
      onchange: () => {
        const { values } = preview.presets[presets.selectedIndex - 1];
        this.#pose(new Map(values.map((value, i) => [preview.controls[i].name, value])));
        presets.selectedIndex = 0;
      },
    }, h("option", {}, "As in …"), preview.presets.map(({ name, mean_mm: mean }) => (
      h("option", {}, Number.isFinite(mean) ? `${plain(name)} (± ${millimetres(mean)} mm)` : plain(name))
    )));
    show(this.#head,
      h("p", { class: "fine" }, "The skin follows the muscles by the solver's physics, in an ", h("strong", {}, preview.errorInWords), ". A muscle's slider contracts it along its fibres."),
      h("div", { class: "row" }, presets,
        h("button", { type: "button", onclick: () => this.#pose(new Map()) }, "Relax all"),
        h("label", { class: "check-field" }, this.#bothSides, "both sides together")));
    setText(this.#legend, `${ERROR} ${FIBRES}`);
    this.#fill(["± mm", "fibres"], preview.controls.map((control, number) => [control.name, this.#sliderRow(control, number)]));
  }

  /** Show a state. */
  show(state) {
    this.#values = state.controls;
    const [strongest] = [...state.expressions].sort((a, b) => b[1] - a[1]);
    const stretches = strongest && this.#face.stretches(this.#face.names.indexOf(strongest[0]));
    for (const [name, row] of this.#rows) {
      row.slider?.set(state.controls.get(name) ?? 0);
      if (!row.muscle) continue;
      row.button.setAttribute("aria-pressed", String(row.muscle === state.muscle));
      const stretch = stretches?.[this.#face.muscles.indexOf(row.muscle)];
      setText(row.stretch, Number.isFinite(stretch) ? `${Math.round(100 * stretch)} %` : "");
    }
  }

  #plainRow(muscle) {
    const button = h("button", { type: "button", class: "plain name", onclick: () => this.#choose(muscle) }, plain(muscle));
    const stretch = stretchFigure();
    return { muscle, title: plain(muscle), button, stretch, element: h("li", { class: "slider" }, button, h("span"), h("span"), h("span"), stretch) };
  }

  #sliderRow({ muscle, title }, number) {
    const error = this.#preview.error.per_control?.[number];
    const slider = new Slider({
      name: plain(title),
      hint: muscle ? "Show this muscle" : "",
      figures: [Number.isFinite(error) ? millimetres(error) : ""],
      moved: (value) => this.#move(number, value),
      chosen: () => muscle && this.#choose(muscle),
    });
    const stretch = stretchFigure();
    slider.element.append(stretch);
    return { muscle, title: plain(title), slider, button: slider.button, stretch, element: slider.element };
  }

  #choose(muscle) {
    this.#change((state) => (state.muscle === muscle ? { muscle: null } : { muscle, inside: true }));
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

  /** Show `rows` of names and rows under the names of their two figures. */
  #fill(names, rows) {
    this.#rows = new Map(rows);
    const heads = names.map((text) => h("span", { class: "figure" }, text));
    show(this.#list,
      h("li", { class: "slider heads", "aria-hidden": "true" }, h("span"), h("span"), h("span"), heads),
      rows.map(([, row]) => row.element));
  }

  #filter(words) {
    for (const row of this.#rows.values()) row.element.hidden = !row.title.toLowerCase().includes(words);
  }
}

/** Room for the length of a muscle's fibres in the expression that is shown, by their length at rest. */
function stretchFigure() {
  return h("span", { class: "figure", title: "Length of the fibres in this expression, by that at rest" });
}
