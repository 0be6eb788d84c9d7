// A row with a name, a slider from 0 to 1, its value, and room for figures.

import { h, setText } from "../dom.js";

/**
 * A row of a list. `moved(value)` is called while the slider moves, `chosen()` when the name is
 * clicked; `figures` are texts behind the slider, `label` is the name for who does not see the rows
 * around it, and `lead` an element before the name.
 */
export class Slider {
  #input;
  #value = h("output", {}, "0.00");

  constructor({ name, hint, moved, chosen, figures = [], key = null, label = name, lead = null }) {
    const id = `slider-${Slider.#made++}`;
    this.#input = h("input", {
      id, type: "range", min: 0, max: 1, step: 0.01, value: 0, "aria-label": label,
      oninput: () => moved(Number(this.#input.value)),
    });
    this.button = h("button", { type: "button", class: "plain name", title: hint, onclick: chosen, "aria-label": label === name ? null : label },
      key && h("kbd", { "aria-hidden": "true" }, key), name);
    this.element = h("li", { class: "slider" }, h("span", { class: "named" }, lead, this.button), this.#input, this.#value,
      figures.map((text) => h("span", { class: "figure" }, text)));
  }

  static #made = 0;

  /** Show a value. */
  set(value) {
    if (Number(this.#input.value) !== value) this.#input.value = value;
    setText(this.#value, value.toFixed(2));
    this.element.toggleAttribute("data-on", value > 0);
  }

  /** Mark the name as the one that was chosen. */
  setChosen(isChosen) {
    this.button.setAttribute("aria-pressed", String(isChosen));
  }
}
