// Placing a session's markers on a person: the face, a dot for each label, a list of them.

import { h, setText } from "../dom.js";
import { doing } from "../parts/toast.js";
import { count } from "../words.js";
import { Figure } from "./figure.js";
import { onKeys } from "./hands.js";
import { MarkerSolids } from "./marker_solids.js";
import { MarkerNames } from "./marker_names.js";
import { PARTS } from "./marker_set.js";
import { StageBox } from "./stage_box.js";

const COLOURS = { face: "#12a37b", head: "#c98a12", upper_teeth: "#2f6fe0", lower_teeth: "#9256d6", ignore: "#8b9298" };
const CHOSEN = "#d6453d";
const CHOSEN_SIZE = 1.5;
const STEP_MM = 1;
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const HINT = "Drag a dot along the skin, or choose a label and move it by Alt and the arrow keys. The arrow goes back to where the marker was in the take.";
const EDGE_ON = 0.1; // cosine between the way out of the skin and that to the camera: names from behind are left out

/** Shows a `MarkerSet` on a `Face`; `save(set)` is called to keep it. */
export class BindingPage {
  #set;
  #figure;
  #solids;
  #save;
  #chosen = 0;
  #pointed = -1;
  #names = new MarkerNames();
  #named = h("input", { type: "checkbox", checked: true, onchange: () => this.#showNames() });
  #mirrored = h("input", { type: "checkbox", onchange: () => this.#showNames() });
  #box = new StageBox("The face with its markers", { expressions: false });
  #rows;
  #told = h("p", { class: "fine", role: "status" });
  #count = h("p", {});

  constructor(face, set, save) {
    this.#set = set;
    this.#save = save;
    this.#figure = new Figure(this.#box.stage, face);
    this.#solids = new MarkerSolids(set.markers.length);
    this.#box.stage.panes[0].add(this.#solids.group);
    this.#box.overlay(this.#names.element);
    this.#rows = set.markers.map((marker, k) => this.#row(marker, k));
    const button = h("button", { type: "button", class: "primary", onclick: () => doing(button, () => this.#save(this.#set)) }, "Save the marker set");
    this.element = h("div", { class: "rig" },
      this.#box.element,
      h("section", { class: "panel rig-poses", "aria-label": "Markers" },
        h("div", { class: "pose" },
          this.#count,
          h("p", { class: "fine" }, HINT),
          h("div", { class: "row" },
            h("label", { class: "check-field" }, this.#named, "names"),
            h("label", { class: "check-field" }, this.#mirrored, "both sides together")),
          h("ul", { class: "marker-rows" }, this.#rows.map(({ element }) => element)),
          this.#told,
          h("div", { class: "row" }, button))));
  }

  /** Show the face, in the document now. */
  start(signal) {
    const { stage } = this.#box;
    this.#box.start(this.#figure.box, "front");
    onKeys(stage, () => {});
    const { canvas } = stage;
    canvas.addEventListener("pointerdown", (event) => this.#grasp(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => event.buttons || this.#point(this.#under(event)));
    canvas.addEventListener("pointerleave", () => this.#point(-1));
    stage.addEventListener("drawn", () => this.#showNames());
    this.element.addEventListener("keydown", (event) => this.#nudge(event));
    this.#show();
    stage.finish();
    this.#figure.shade(signal).catch(() => {}); // hollows are then lit as all else
  }

  dispose() {
    this.#box.dispose();
  }

  #row(marker, k) {
    const name = h("input", {
      type: "text",
      value: marker.label, "aria-label": `Label ${marker.label}`, autocomplete: "off", spellcheck: "false",
      onfocus: () => this.#choose(k),
      onchange: () => this.#rename(k, name),
    });
    const part = h("select", { "aria-label": `What ${marker.label} rides on`, onfocus: () => this.#choose(k), onchange: () => this.#change(() => this.#set.setPart(k, part.value)) },
      Object.entries(PARTS).map(([value, title]) => h("option", { value, selected: value === marker.part }, title)));
    const moved = h("span", { class: "figure" });
    const element = h("li", {
      class: "marker-row", onpointerenter: () => this.#point(k), onpointerleave: () => this.#point(-1),
    }, name, part, moved);
    return { element, name, part, moved };
  }

  #rename(k, field) {
    const why = this.#set.rename(k, field.value);
    field.setCustomValidity(why ?? "");
    setText(this.#told, why ?? "");
    if (!why) this.#show();
  }

  #change(action) {
    action();
    this.#show();
  }

  /** Move the chosen marker, and its twin to the mirror image of where it then is. */
  #move(action) {
    this.#change(() => {
      action();
      if (this.#mirrored.checked) this.#set.mirror(this.#chosen);
    });
  }

  #choose(k) {
    if (this.#chosen === k) return;
    this.#chosen = k;
    this.#show();
  }

  /** Mark what is pointed at, a dot or a row: its name is seen wherever it lies. */
  #point(k) {
    if (this.#pointed === k) return;
    this.#rows[this.#pointed]?.element.removeAttribute("data-near");
    this.#pointed = k;
    this.#rows[k]?.element.setAttribute("data-near", "");
    this.#showNames();
  }

  /** Return the marker whose dot is under the pointer, -1 for none. */
  #under(event) {
    const { stage } = this.#box;
    const [dot] = stage.pick(event, [this.#solids.dots]);
    const [skin] = stage.pick(event, [this.#figure.skin.mesh]);
    if (!dot || (skin && skin.distance < dot.distance - this.#reach)) return -1;
    return this.#solids.markerOf(dot.faceIndex);
  }

  /** Take hold of a dot under the pointer, and move it with the pointer until that is let go of. */
  #grasp(event) {
    const { stage } = this.#box;
    if (event.button !== 0) return;
    const k = this.#under(event);
    if (k < 0) return;
    event.stopImmediatePropagation(); // the face does not turn meanwhile
    event.preventDefault();
    this.#choose(k);
    this.#rows[k].element.scrollIntoView({ block: "nearest" });
    const { canvas } = stage;
    canvas.setPointerCapture(event.pointerId);
    const move = (moved) => {
      const [hit] = stage.pick(moved, [this.#figure.skin.mesh]);
      if (!hit) return;
      const { a, b, c } = hit.face;
      this.#move(() => this.#set.put(k, [a, b, c], hit.point.toArray()));
    };
    const ending = new AbortController();
    canvas.addEventListener("pointermove", move, { signal: ending.signal });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => ending.abort(), { once: true });
  }

  /** How much deeper than the skin a dot may lie and still be grasped, mm. */
  get #reach() {
    return 3;
  }

  /** Move the chosen marker by the arrow keys with Alt, along the skin as it is seen. */
  #nudge(event) {
    const step = event.altKey && STEPS[event.key];
    if (!step) return;
    event.preventDefault();
    const { elements } = this.#box.stage.camera.matrixWorld;
    const place = this.#set.placeOf(this.#set.markers[this.#chosen]);
    const to = place.map((each, d) => each + STEP_MM * (step[0] * elements[d] + step[1] * elements[4 + d]));
    this.#move(() => this.#set.putNear(this.#chosen, to));
  }

  /** Show the names beside the dots that face the camera. */
  #showNames() {
    const { stage } = this.#box;
    const { markers } = this.#set;
    const eye = stage.camera.position.toArray();
    const points = markers.map((marker, k) => {
      const place = this.#set.placeOf(marker);
      const out = this.#set.outward(k);
      const way = eye.map((each, d) => each - place[d]);
      const facing = out ? out.reduce((sum, each, d) => sum + each * way[d], 0) / Math.hypot(...way) : 1;
      return facing > EDGE_ON ? stage.project(place) : null;
    });
    const twin = this.#mirrored.checked ? this.#set.twin(this.#chosen) : -1;
    const first = [this.#chosen, twin, this.#pointed].filter((k) => points[k]);
    const shown = this.#named.checked ? points : points.map((point, k) => (first.includes(k) ? point : null));
    this.#names.show(markers.map(({ label }) => label), shown, stage.size, first);
  }

  /** Show the set as it is now. */
  #show() {
    const { markers } = this.#set;
    const places = new Float32Array(markers.flatMap((each) => this.#set.placeOf(each)));
    const off = new Float32Array(markers.flatMap((_, k) => this.#set.seen(k).map((each, d) => each - places[3 * k + d])));
    const colours = markers.map(({ part }, k) => (k === this.#chosen ? CHOSEN : COLOURS[part]));
    this.#solids.set(places, off, colours, { sizes: markers.map((_, k) => (k === this.#chosen ? CHOSEN_SIZE : 1)) });
    markers.forEach(({ part }, k) => {
      const row = this.#rows[k];
      row.part.value = part;
      row.element.toggleAttribute("data-on", k === this.#chosen);
      const way = this.#set.moved(k);
      setText(row.moved, way > 0.05 ? `${way.toFixed(1)} mm` : "");
    });
    const moved = markers.filter((_, k) => this.#set.moved(k) > 0.05).length;
    setText(this.#count, `${count(markers.length, "marker")}${moved ? `, ${moved} moved` : ""}`);
    this.#box.stage.invalidate();
    // for tests
    this.element.dispatchEvent(new CustomEvent("placed", { detail: { places, chosen: this.#chosen } }));
  }
}
