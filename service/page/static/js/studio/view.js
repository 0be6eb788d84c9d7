// The view of a studio's rig: the head in 3D, its shapes as sliders, and what of its skin is shown.

import { h } from "../dom.js";
import { Slider } from "../rig/slider.js";
import { StageBox } from "../rig/stage_box.js";

const POSES = {
  Neutral: {},
  "Eyes shut": { eyeBlinkLeft: 1, eyeBlinkRight: 1 },
  "Jaw open": { jawOpen: 1 },
  Smile: { mouthSmileLeft: 1, mouthSmileRight: 1, cheekSquintLeft: 0.6, cheekSquintRight: 0.6 },
  "Brows up": { browInnerUp: 1, browOuterUpLeft: 1, browOuterUpRight: 1 },
};
const LAYERS = { colours: "Colours", normals: "Normal map", wrinkles: "Wrinkles" };

/** Shows a `StudioModel`; `element` is in the document when it is started. */
export class StudioView {
  #box = new StageBox("The studio's rig", { expressions: false });
  #model;
  #rows;
  #weights = new Map();

  constructor(model) {
    this.#model = model;
    this.#rows = new Map(model.names.map((name) => [name, new Slider({
      name,
      hint: "Show this shape alone",
      moved: (value) => this.pose(new Map(this.#weights).set(name, value)),
      chosen: () => this.pose(new Map([[name, 1]])),
    })]));
    const poses = Object.entries(POSES).map(([words, weights]) => (
      h("button", { type: "button", onclick: () => this.pose(new Map(Object.entries(weights))) }, words)
    ));
    const layers = Object.entries(LAYERS).filter(([name]) => model.has[name]).map(([name, words]) => {
      const box = h("input", { type: "checkbox", checked: true, onchange: () => this.#wear(name, box.checked) });
      return h("label", { class: "check-field" }, box, words);
    });
    this.element = h("div", { class: "studio" },
      h("div", { class: "look-bar" }, h("div", { class: "row" }, poses), h("div", { class: "row" }, layers)),
      this.#box.element,
      h("ol", { class: "sliders", tabindex: 0, "aria-label": "Shapes" }, [...this.#rows.values()].map((row) => row.element)));
  }

  /** Begin to show the neutral. */
  start() {
    this.#box.stage.panes[0].add(this.#model.root);
    this.#box.start(this.#model.box, "front");
    this.pose(new Map());
  }

  /** Show shapes by their weights, name -> 0 to 1. */
  pose(weights) {
    const shown = [...weights].filter(([name, value]) => value > 0 && this.#rows.has(name));
    this.#weights = new Map(shown);
    for (const [name, row] of this.#rows) row.set(this.#weights.get(name) ?? 0);
    this.#model.pose(this.#weights);
    this.#tell();
  }

  dispose() {
    this.#box.dispose();
  }

  #wear(layer, isOn) {
    const { detail } = this.#model;
    if (layer === "colours") this.#model.setColours(isOn);
    if (layer === "normals") detail.setNormals(isOn);
    if (layer === "wrinkles") detail.setWrinkles(isOn);
    this.#tell();
  }

  /** Draw, and say which wrinkles there are. */
  #tell() {
    this.#box.stage.invalidate();
    const told = [...this.#model.detail.strengths].filter(([, value]) => value > 0)
      .map(([name, value]) => `${name} ${value.toFixed(2)}`);
    this.#box.describe(told.length ? `Wrinkles: ${told.join(", ")}` : "");
  }
}
