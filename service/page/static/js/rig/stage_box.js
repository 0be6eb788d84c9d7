// The canvas in the page: its names, messages and words, and its colours in light and dark.

import { h, setText, show } from "../dom.js";
import { Stage } from "./stage.js";

const TURNS = "Arrow keys turn the face, plus and minus zoom.";
const KEYS = "Arrow keys turn the face, plus and minus zoom, 1 to 9 show an expression, 0 the neutral.";

/** An element with a stage in it. */
export class StageBox {
  #names = h("div", { class: "pane-names" });
  #message = h("p", { class: "stage-message", role: "status" });
  #picked = h("p", { class: "stage-picked" });
  #caption = h("p", { class: "stage-caption fine", id: "stage-caption", "aria-live": "polite" });
  #repaint = () => this.stage.setBackground(getComputedStyle(this.#room).backgroundColor);
  #room;

  /** `label` says in a few words what the picture is of; without `expressions` digits show none. */
  constructor(label, { expressions = true } = {}) {
    const canvas = h("canvas", {
      class: "stage", tabindex: 0, role: "img", "aria-label": label, "aria-describedby": "stage-caption stage-keys",
    });
    this.#room = h("div", { class: "stage-room" }, canvas, this.#names, this.#message, this.#picked);
    this.element = h("figure", { class: "stage-box" }, this.#room,
      h("figcaption", {}, this.#caption, h("p", { class: "fine", id: "stage-keys" }, expressions ? KEYS : TURNS)));
    this.stage = new Stage(canvas);
    document.addEventListener("themechange", this.#repaint);
  }

  /** Begin to show; the element is in the document now. */
  start(box, view) {
    this.#repaint();
    this.stage.frame(...box);
    this.stage.look(view);
  }

  /** Put something over the picture. */
  overlay(element) {
    this.#room.append(element);
  }

  /** Have a pane for each name. */
  setPanes(names) {
    if (this.#names.childElementCount === names.length) return;
    show(this.#names, names.map((name) => h("span", {}, name)));
    this.stage.setPanes(names.length);
  }

  /** Say something over the picture; nothing for no text. */
  say(text) {
    setText(this.#message, text);
  }

  /** Name what was picked; nothing for no text. */
  name(text) {
    setText(this.#picked, text);
  }

  /** Set what the picture shows, in words. */
  describe(text) {
    setText(this.#caption, text);
  }

  dispose() {
    document.removeEventListener("themechange", this.#repaint);
    this.stage.dispose();
  }
}
