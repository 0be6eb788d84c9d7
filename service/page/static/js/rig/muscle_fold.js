// A whole muscle over its compartments: one row for all, which folds the rows of its parts away.

import { h } from "../dom.js";

/** The fold of one whole; `row` is its own row, made with `lead` in front of its name. */
export class MuscleFold {
  #parts;
  #isOpen = false;
  #words = "";

  constructor(title, rowOf, parts) {
    this.#parts = parts;
    this.lead = h("button", {
      type: "button", class: "plain lead", "aria-label": `Parts of ${title}`, onclick: () => this.open(!this.#isOpen),
    });
    this.row = rowOf(this.lead);
    this.open(false);
  }

  get elements() {
    return [this.row.element, ...this.#parts.map((part) => part.element)];
  }

  /** Show the rows of the parts, or fold them away. */
  open(isOpen) {
    this.#isOpen = isOpen;
    this.lead.setAttribute("aria-expanded", String(isOpen));
    this.filter(this.#words);
  }

  /** Leave what has these words in its title: of a whole that has them, what is unfolded. */
  filter(words) {
    this.#words = words;
    const isMeant = has(this.row, words);
    for (const part of this.#parts) part.element.hidden = !(isMeant ? this.#isOpen : has(part, words));
    this.row.element.hidden = !isMeant && this.#parts.every((part) => part.element.hidden);
  }
}

/** Whether a row's title has words, in any case. */
export function has(row, words) {
  return row.title.toLowerCase().includes(words.toLowerCase());
}
