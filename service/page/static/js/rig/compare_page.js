// Two rigs side by side: the same expression, the same camera, and where they differ.

import { h } from "../dom.js";
import { figure } from "../words.js";
import { blend, distances, millimetres } from "./face.js";
import { Figure } from "./figure.js";
import { onKeys } from "./hands.js";
import { Legend } from "./heat.js";
import { LookBar } from "./look_bar.js";
import { ExpressionPanel, pose } from "./pose_panel.js";
import { StageBox } from "./stage_box.js";
import { summary } from "./summary.js";

const SETTLED_MS = 250;
const HEATS = {
  distance: ["Distance to the scan", 2],
  difference: ["Distance between the two", 2],
  movement: ["Difference of their movements", 2],
};

/** The comparison of two rigs, each { rig, subject, face }; `change` is fired when its state settled. */
export class ComparePage extends EventTarget {
  #sides;
  #signal;
  #names;
  #agree;
  #figures;
  #box = new StageBox("The two faces");
  #legend = new Legend((low, high) => this.change({ heat: { ...this.state.heat, low, high } }));
  #panels;
  #heat = null;
  #isStale = true;
  #settling = 0;

  constructor(sides, state, signal) {
    super();
    this.#sides = sides;
    this.#signal = signal;
    const [a, b] = sides.map(({ face }) => face);
    this.#names = a.names.filter((name) => b.names.includes(name));
    this.#agree = a.faces.length === b.faces.length && a.faces.every((vertex, i) => vertex === b.faces[i]);
    const heats = Object.entries(HEATS).filter(([of]) => (of === "distance" ? a.hasScans && b.hasScans : this.#agree));
    this.state = {
      ...state,
      expressions: new Map([...state.expressions].filter(([name]) => this.#names.includes(name))),
      heat: heats.some(([of]) => of === state.heat?.of) ? state.heat : null,
      controls: new Map(), take: null, scan: null, inside: false, muscle: null, section: null,
    };
    this.#box.setPanes(sides.map(({ subject }, i) => `${"AB"[i]}: ${subject.name}`));
    this.#figures = sides.map(({ face }, i) => new Figure(this.#box.stage, face, i));
    const change = (patch) => this.change(patch);
    const look = new LookBar({ heats: heats.map(([of, [title, most]]) => [of, title, most]), change });
    const expressions = new ExpressionPanel({
      rows: this.#names.map((name) => ({ name, figures: meansOf(name, a, b) })),
      heads: ["A", "B", "B − A"],
      explained: "Mean distance to the scan in mm",
      change,
    });
    this.#panels = [look, expressions];
    this.#box.overlay(this.#legend.element);
    this.element = h("div", { class: "rig" }, look.element, this.#box.element,
      h("section", { class: "panel rig-poses", "aria-label": "What both faces do" }, expressions.element),
      h("section", { class: "panel compare-figures" }, h("h2", {}, "Figures"), this.#table(),
        !this.#agree && h("p", { class: "fine" }, "The two have different topologies, so there is no map of their difference.")));
  }

  /** Show the faces, in the document now. */
  start() {
    const { stage } = this.#box;
    this.#box.start(around(this.#figures.map((side) => side.box)), this.state.view);
    stage.addEventListener("draw", () => this.#isStale && this.#pose());
    stage.addEventListener("look", () => {
      this.state.view = stage.view;
      this.#panels[0].show(this.state);
      this.#settleSoon();
    });
    onKeys(stage, (number) => {
      const name = this.#names[number - 1];
      if (number === 0 || name) this.change(pose(name ? new Map([[name, 1]]) : new Map()));
    });
    this.#update();
    stage.finish();
    for (const side of this.#figures) side.shade(this.#signal).catch(() => {}); // it ends with the view
  }

  /** Take a part of a state. */
  change(patch) {
    this.state = { ...this.state, ...patch };
    if (patch.view) this.#box.stage.look(patch.view);
    this.#update();
  }

  dispose() {
    clearTimeout(this.#settling);
    this.#box.dispose();
  }

  #update() {
    for (const panel of this.#panels) panel.show(this.state);
    this.#isStale = true;
    this.#box.stage.invalidate();
    this.#settleSoon();
  }

  #pose() {
    this.#isStale = false;
    this.#sides.forEach(({ face }, i) => {
      blend(this.#figures[i].places, face.neutral, this.#weights(face), (k) => face.skin(k));
    });
    const { heat } = this.state;
    this.#heat = heat && { title: HEATS[heat.of][0], values: this.#values(heat.of) };
    this.#figures.forEach((side, i) => {
      side.skin.setHeat(this.#heat?.values[i] ?? null);
      if (heat) side.skin.setRange(heat.low, heat.high);
      side.moved();
    });
    if (heat) this.#legend.show(this.#heat.title, heat.low, heat.high, heat.of === "distance");
    else this.#legend.hide();
  }

  /** Return the values of a heat map for A and B. */
  #values(of) {
    const [a, b] = this.#figures;
    const [faceA, faceB] = this.#sides.map(({ face }) => face);
    if (of === "distance") return [faceA, faceB].map((face) => this.#error(face));
    if (of === "difference") {
      const values = distances(a.places, b.places);
      return [values, values];
    }
    const way = ({ places }, { neutral }) => places.map((value, i) => value - neutral[i]);
    const values = distances(way(a, faceA), way(b, faceB));
    return [values, values];
  }

  /** Return the distance to the scan: the strongest expression's, or the greatest of all. */
  #error(face) {
    const [strongest] = [...this.state.expressions].sort((a, b) => b[1] - a[1]);
    return strongest ? face.error(face.names.indexOf(strongest[0])) : face.worst();
  }

  #weights(face) {
    return face.names.map((name) => this.state.expressions.get(name) ?? 0);
  }

  #settleSoon() {
    clearTimeout(this.#settling);
    this.#settling = setTimeout(() => {
      if (this.#isStale) this.#box.stage.draw(); // what is said is what is drawn
      this.#box.describe(summary(this.state, { heats: this.#heats(), take: null }));
      this.dispatchEvent(new Event("change"));
    }, SETTLED_MS);
  }

  /** Return title and values of the heat maps that are shown: one of each face, or one of both. */
  #heats() {
    if (!this.#heat) return [];
    const { title, values } = this.#heat;
    if (this.state.heat.of !== "distance") return [{ title, values: values[0] }];
    return values.map((each, i) => ({ title: `${title}, ${"AB"[i]}`, values: each }));
  }

  #table() {
    const rows = [
      ["Training mean, mm", ({ rig }) => rig.summary.train_mean_mm],
      ["Unseen mean, mm", ({ rig }) => rig.summary.test_mean_mm],
      ["Inverted tets", ({ rig }) => rig.summary.inverted],
      ["Expressions", ({ face }) => face.names.length],
      ["Muscles", ({ face }) => face.muscles.length],
      ["Vertices", ({ face }) => face.count],
    ];
    return h("div", { class: "scroll" }, h("table", {},
      h("thead", {}, h("tr", {}, h("td"), this.#sides.map(({ subject }, i) => h("th", { class: "number", scope: "col" }, `${"AB"[i]}: ${subject.name}`)), h("th", { class: "number", scope: "col" }, "B − A"))),
      h("tbody", {}, rows.map(([title, of]) => {
        const [a, b] = this.#sides.map(of);
        const known = Number.isFinite(a) && Number.isFinite(b);
        return h("tr", {}, h("th", { scope: "row" }, title),
          [a, b, known ? b - a : null].map((value) => h("td", { class: "number" }, figure(value))));
      }))));
  }
}

/** Return the box around boxes. */
function around(boxes) {
  const end = (corner, least) => [0, 1, 2].map((d) => least(...boxes.map((box) => box[corner][d])));
  return [end(0, Math.min), end(1, Math.max)];
}

function meansOf(name, a, b) {
  const [of, other] = [a, b].map((face) => face.expressions[face.names.indexOf(name)].mean_mm);
  const known = Number.isFinite(of) && Number.isFinite(other);
  return [millimetres(of), millimetres(other), known ? (other - of).toFixed(2) : "–"];
}
