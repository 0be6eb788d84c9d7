// Controls of how the face is shown: heat map, scan, inside, section, camera.

import { h } from "../dom.js";
import { CUT_VIEWS, VIEWS } from "./stage.js";

const VIEW_NAMES = {
  front: ["Front", "From the front"],
  "three-quarter": ["¾", "Three quarter"],
  side: ["Right", "Right side"],
  "other-side": ["Left", "Left side"],
};

const LEAST_FACING = 0.5; // cosine of the angle between the line of sight and the axis

/**
 * A row of controls; `change(patch)` takes a part of a state. `heats` are [name, title, most mm];
 * `box` is the face's, for sections.
 */
export class LookBar {
  #heat;
  #scan;
  #inside;
  #axis;
  #at;
  #views;
  #box;

  constructor({ heats, change, box = null, hasScans = false, hasInside = false }) {
    this.#box = box;
    this.#heat = h("select", {
      onchange: () => {
        const chosen = heats.find(([name]) => name === this.#heat.value);
        change({ heat: chosen ? { of: chosen[0], low: 0, high: chosen[2] } : null });
      },
    }, h("option", { value: "" }, "Off"), heats.map(([name, title]) => h("option", { value: name }, title)));
    this.#scan = h("select", { onchange: () => change({ scan: this.#scan.value || null }) },
      [["", "Off"], ["clear", "Half transparent"], ["wire", "Net"], ["beside", "Side by side"]]
        .map(([value, title]) => h("option", { value }, title)));
    this.#inside = h("input", { type: "checkbox", onchange: () => change({ inside: this.#inside.checked, muscle: null }) });
    this.#axis = h("select", { onchange: () => change((state) => this.#cut(state)) },
      [["", "Off"], ["x", "Left to right"], ["y", "Bottom to top"], ["z", "Back to front"]]
        .map(([value, title]) => h("option", { value }, title)));
    this.#at = h("input", {
      type: "range", step: 0.5, "aria-label": "Place of the section, mm",
      oninput: () => change({ section: { axis: this.#axis.value, at: Number(this.#at.value) } }),
    });
    this.#views = Object.keys(VIEWS).map((name) => (
      h("button", {
        type: "button", "data-view": name, title: VIEW_NAMES[name][1], "aria-label": VIEW_NAMES[name][1],
        onclick: () => change({ view: name }),
      }, VIEW_NAMES[name][0])
    ));
    this.element = h("div", { class: "look-bar", role: "toolbar", "aria-label": "How the face is shown" },
      field("Heat map", this.#heat),
      hasScans && field("Scan", this.#scan),
      hasInside && h("label", { class: "check-field" }, this.#inside, "Muscles and bones"),
      hasInside && field("Section", this.#axis, this.#at),
      h("div", { class: "row views", role: "group", "aria-label": "Camera" }, this.#views));
  }

  /** Show a state. */
  show(state) {
    this.#heat.value = state.heat?.of ?? "";
    this.#scan.value = state.scan ?? "";
    this.#inside.checked = state.inside;
    this.#axis.value = state.section?.axis ?? "";
    this.#at.hidden = !state.section;
    if (state.section) {
      const d = "xyz".indexOf(state.section.axis);
      [this.#at.min, this.#at.max] = [Math.ceil(this.#box[0][d]), Math.floor(this.#box[1][d])];
      this.#at.value = state.section.at;
    }
    for (const button of this.#views) {
      button.setAttribute("aria-pressed", String(button.dataset.view === state.view));
    }
  }

  /** Return what shows a section through the middle: where the camera sees it edge on, it turns. */
  #cut({ section, view }) {
    const axis = this.#axis.value;
    const isSeen = !axis || section?.axis === axis || faces(VIEWS[view] ?? view, axis);
    return { section: this.#middle(axis), ...(isSeen ? {} : { view: CUT_VIEWS[axis] }) };
  }

  /** Return a section through the middle of the face. */
  #middle(axis) {
    if (!axis) return null;
    const d = "xyz".indexOf(axis);
    return { axis, at: Math.round((this.#box[0][d] + this.#box[1][d]) / 2) };
  }
}

function field(title, control, more = null) {
  control.id = `look-${title.toLowerCase().replace(" ", "-")}`;
  return h("div", { class: "look-field" }, h("label", { for: control.id }, title), h("div", { class: "row" }, control, more));
}

/** Whether a camera at some azimuth and elevation, in degrees, looks along an axis rather than across. */
function faces([azimuth, elevation], axis) {
  const [a, e] = [azimuth, elevation].map((degrees) => (degrees * Math.PI) / 180);
  const way = { x: Math.sin(a) * Math.cos(e), y: Math.sin(e), z: Math.cos(a) * Math.cos(e) };
  return Math.abs(way[axis]) > LEAST_FACING;
}
