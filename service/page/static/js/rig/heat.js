// The legend of the heat map, with its range in millimetres.

import { h } from "../dom.js";
import { heatColours } from "./colours.js";

const STRIPE = 256;

/** A legend whose ends can be set; `changed(low, high)` is called when they are. */
export class Legend {
  #low = field("Least", 0);
  #high = field("Most", 2);
  #title = h("figcaption");

  constructor(changed) {
    this.element = h("figure", { class: "heat-legend", hidden: true },
      this.#title,
      h("div", { class: "heat-scale" }, this.#low, stripe(), this.#high, h("span", {}, "mm")),
      h("p", { class: "fine" }, h("span", { class: "unseen-swatch", "aria-hidden": "true" }), "grey: the scan shows nothing there"));
    for (const input of [this.#low, this.#high]) {
      input.addEventListener("change", () => {
        const [low, high] = [Number(this.#low.value), Number(this.#high.value)];
        const isRange = Number.isFinite(low) && Number.isFinite(high) && low >= 0 && low < high;
        input.setCustomValidity(isRange ? "" : "The least must be below the most.");
        if (isRange) changed(low, high);
        else input.reportValidity();
      });
    }
  }

  /** Say what the colours are of. */
  show(title, low, high, hasUnseen) {
    this.element.hidden = false;
    this.#title.textContent = title;
    this.#low.value = low;
    this.#high.value = high;
    this.element.lastChild.hidden = !hasUnseen;
  }

  hide() {
    this.element.hidden = true;
  }
}

function field(label, value) {
  return h("input", { type: "number", min: 0, step: 0.1, value, "aria-label": `${label}, mm` });
}

/** Draw the map once, low at the left. */
function stripe() {
  const canvas = h("canvas", { width: STRIPE, height: 1, class: "heat-stripe", "aria-hidden": "true" });
  const drawing = canvas.getContext("2d");
  heatColours().forEach((colour, i) => {
    drawing.fillStyle = `rgb(${colour.map((value) => Math.round(255 * value)).join(" ")})`;
    drawing.fillRect(i, 0, 1, 1);
  });
  return canvas;
}
