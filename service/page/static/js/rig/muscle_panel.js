// The muscles: their sliders where the rig has an approximation, else their names.

import { h, setText, show } from "../dom.js";
import { plain } from "../words.js";
import { millimetres } from "./face.js";
import { has, MuscleFold } from "./muscle_fold.js";
import { positive } from "./pose_panel.js";
import { Slider } from "./slider.js";

const ERROR = "± mm: how far the skin of a slider alone is off the simulation.";
const CONTRACTS = "contracts: how much shorter its fibres are in what is shown, in % of their length; − longer, · the muscle holds still.";

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
    setText(this.#legend, CONTRACTS);
    this.#fill(["", "contracts"], this.#face.muscles.map((muscle) => ({ name: muscle, muscle, title: muscle })), (named) => this.#plainRow(named));
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
    setText(this.#legend, `${ERROR} ${CONTRACTS}`);
    this.#fill(["± mm", "contracts"], preview.controls, (named, numbers) => this.#sliderRow(named, numbers));
  }

  /** Show a state; the sliders follow the frame of the `take` that it names, or its expressions. */
  show(state, take) {
    const played = state.take ? take?.contractions : null;
    const found = played ? this.#inOrder(played, state.take.frame) : this.#ofExpressions(state.expressions);
    this.#values = state.controls;
    if (this.#preview && played) {
      const contracted = new Map(this.#face.muscles.map((name, m) => [name, found[m]]));
      this.#values = this.#preview.valuesOf(contracted, played.jaw(state.take.frame));
    } else if (this.#preview && state.expressions.size) this.#values = this.#preview.valuesIn(state.expressions);
    for (const { muscle, names, slider, button, contracted } of this.#rows) {
      slider?.set(Math.max(...names.map((name) => this.#values.get(name) ?? 0)));
      if (!muscle) continue;
      button.setAttribute("aria-pressed", String(muscle === state.muscle));
      setText(contracted, found ? this.#inWords(this.#face.of(muscle, found)) : "");
    }
    if (state.muscle !== this.#chosen) this.#folds.get(state.muscle)?.open(true);
    this.#chosen = state.muscle;
  }

  /** Return the contractions of a frame in the order of the face's muscles. */
  #inOrder(played, frame) {
    const values = played.at(frame);
    return this.#face.muscles.map((name) => values[played.muscles.indexOf(name)] ?? NaN);
  }

  /** Return the contractions of a blend of expressions, in which they are linear; null without any. */
  #ofExpressions(expressions) {
    if (!expressions.size) return null;
    const rows = [...expressions].map(([name, weight]) => [this.#face.contractions(this.#face.names.indexOf(name)), weight]);
    if (rows.some(([row]) => !row)) return null;
    return this.#face.muscles.map((_, m) => rows.reduce((sum, [row, weight]) => sum + weight * row[m], 0));
  }

  #inWords(contraction) {
    if (!Number.isFinite(contraction)) return "";
    const [least, most] = this.#face.still;
    if (contraction > least && contraction < most) return "·";
    return `${Math.round(100 * contraction)} %`.replace("-", "−");
  }

  #plainRow({ muscle, name, title, lead }) {
    const button = h("button", { type: "button", class: "plain name", "aria-label": title, onclick: () => this.#choose(muscle) }, name);
    const contracted = contractionFigure();
    const element = h("li", { class: "slider" }, h("span", { class: "named" }, lead, button), h("span"), h("span"), h("span"), contracted);
    return { button, contracted, element };
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
    const contracted = contractionFigure();
    slider.element.append(contracted);
    return { slider, button: slider.button, contracted, element: slider.element };
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
    this.#change({ controls: positive(controls), expressions: new Map(), take: null, live: null });
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

/** Room for how much a muscle contracts in what is shown. */
function contractionFigure() {
  return h("span", { class: "figure", title: "How much shorter its fibres are, in % of their length" });
}
