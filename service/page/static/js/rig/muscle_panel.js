// The muscles: their sliders where the rig has an approximation, else their names.

import { h, setText, show } from "../dom.js";
import { plain } from "../words.js";
import { millimetres } from "./face.js";
import { has, MuscleFold } from "./muscle_fold.js";
import { positive } from "./pose_panel.js";
import { Slider } from "./slider.js";

const ERROR = "± mm: how far the skin of a slider alone is off the simulation.";
const FIBRES = "fibres: their length in the expression that is shown, by that at rest; below 100 % the muscle is short.";

/** Muscles and jaw; `change(patch)` takes a part of a state, or what a function makes of one. */
export class MusclePanel {
  #face;
  #change;
  #preview = null;
  #rows = [];
  #blocks = [];
  #folds = new Map();
  #chosen = null;
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
      oninput: () => this.#filter(search.value.trim()),
    });
    this.element = h("div", { class: "pose" }, this.#head, search, this.#legend, this.#list);
    this.setMissing(h("p", { class: "fine" }, "Loading the sliders …"));
  }

  /** Have no sliders; `instead` are elements or texts. */
  setMissing(...instead) {
    show(this.#head, instead);
    setText(this.#legend, FIBRES);
    this.#fill(["", "fibres"], this.#face.muscles.map((muscle) => ({ name: muscle, muscle, title: muscle })), (named) => this.#plainRow(named));
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
    this.#fill(["± mm", "fibres"], preview.controls, (named, numbers) => this.#sliderRow(named, numbers));
  }

  /** Show a state. */
  show(state) {
    this.#values = state.controls;
    const [strongest] = [...state.expressions].sort((a, b) => b[1] - a[1]);
    const expression = strongest ? this.#face.names.indexOf(strongest[0]) : -1;
    for (const { muscle, names, slider, button, stretch } of this.#rows) {
      const values = names.map((name) => state.controls.get(name) ?? 0);
      slider?.set(values.reduce((sum, value) => sum + value, 0) / values.length);
      if (!muscle) continue;
      button.setAttribute("aria-pressed", String(muscle === state.muscle));
      const length = expression < 0 ? NaN : this.#face.stretch(expression, muscle);
      setText(stretch, Number.isFinite(length) ? `${Math.round(100 * length)} %` : "");
    }
    if (state.muscle !== this.#chosen) this.#folds.get(state.muscle)?.open(true);
    this.#chosen = state.muscle;
  }

  #plainRow({ muscle, name, title, lead }) {
    const button = h("button", { type: "button", class: "plain name", "aria-label": title, onclick: () => this.#choose(muscle) }, name);
    const stretch = stretchFigure();
    const element = h("li", { class: "slider" }, h("span", { class: "named" }, lead, button), h("span"), h("span"), h("span"), stretch);
    return { button, stretch, element };
  }

  #sliderRow({ muscle, name, title, lead }, numbers) {
    const error = numbers.length === 1 ? this.#preview.error.per_control?.[numbers[0]] : NaN;
    const slider = new Slider({
      name,
      label: title,
      lead,
      hint: muscle ? "Show this muscle" : "",
      figures: [Number.isFinite(error) ? millimetres(error) : ""],
      moved: (value) => this.#move(numbers, value),
      chosen: () => muscle && this.#choose(muscle),
    });
    const stretch = stretchFigure();
    slider.element.append(stretch);
    return { slider, button: slider.button, stretch, element: slider.element };
  }

  #choose(muscle) {
    this.#change((state) => (state.muscle === muscle ? { muscle: null } : { muscle, inside: true }));
  }

  #move(numbers, value) {
    const values = new Map(this.#values);
    for (const number of numbers) {
      const partner = this.#bothSides.checked ? this.#preview.partner(number) : -1;
      for (const each of partner < 0 ? [number] : [number, partner]) values.set(this.#preview.controls[each].name, value);
    }
    this.#pose(values);
  }

  #pose(controls) {
    this.#change({ controls: positive(controls), expressions: new Map(), take: null });
  }

  /**
   * Show a row for each control under the names of their two figures, compartments folded under their
   * whole; `rowOf(named, numbers)` makes the row of the controls of these numbers.
   */
  #fill(heads, controls, rowOf) {
    this.#rows = [];
    this.#folds = new Map();
    const make = (named, numbers) => {
      const names = numbers.map((number) => controls[number].name);
      const row = { muscle: named.muscle, title: named.title, names, ...rowOf(named, numbers) };
      this.#rows.push(row);
      return row;
    };
    const blocks = [...this.#wholes(controls)].map(([whole, numbers]) => {
      if (numbers.length === 1) {
        const { muscle, title } = controls[numbers[0]];
        return make({ muscle, name: plain(title), title: plain(title) }, numbers);
      }
      const parts = numbers.map((number) => {
        const { muscle } = controls[number];
        const row = make({ muscle, name: plain(partName(muscle, whole)), title: plain(muscle) }, [number]);
        row.element.classList.add("part");
        return row;
      });
      const named = { muscle: whole, name: plain(whole), title: plain(whole) };
      const fold = new MuscleFold(named.title, (lead) => make({ ...named, lead }, numbers), parts);
      for (const { muscle } of parts) this.#folds.set(muscle, fold);
      return fold;
    });
    this.#blocks = blocks;
    const titles = heads.map((text) => h("span", { class: "figure" }, text));
    show(this.#list,
      h("li", { class: "slider heads", "aria-hidden": "true" }, h("span"), h("span"), h("span"), titles),
      blocks.map((block) => block.elements ?? block.element));
  }

  /** Return whole muscle, or the name of what is none, -> the numbers of its controls. */
  #wholes(controls) {
    const found = new Map();
    for (const [number, { name, muscle }] of controls.entries()) {
      const whole = this.#face.wholes[this.#face.muscles.indexOf(muscle)] ?? name;
      found.set(whole, [...(found.get(whole) ?? []), number]);
    }
    return found;
  }

  #filter(words) {
    for (const block of this.#blocks) {
      if (block.filter) block.filter(words);
      else block.element.hidden = !has(block, words);
    }
  }
}

/** Return a compartment's own name, which its whole's and a dot go before. */
function partName(muscle, whole) {
  return muscle.startsWith(`${whole}.`) ? muscle.slice(whole.length + 1) : muscle;
}

/** Room for the length of a muscle's fibres in the expression that is shown, by their length at rest. */
function stretchFigure() {
  return h("span", { class: "figure", title: "Length of the fibres in this expression, by that at rest" });
}
