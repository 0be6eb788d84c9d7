// How much muscles contract in a fitted sequence, frame by frame, from `contractions.bin`.

import { Container } from "./container.js";

/** Contractions of m muscles, parts of their fibres' length, and the jaw's five numbers. */
export class Contractions {
  #file;

  constructor(buffer) {
    this.#file = new Container(buffer);
    this.muscles = this.#file.header.muscles;
  }

  /** Return how much each muscle contracts in a frame, NaN where unknown. */
  at(frame) {
    return this.#row("contraction", frame, this.muscles.length);
  }

  /** Return the jaw's numbers in a frame. */
  jaw(frame) {
    return this.#row("jaw", frame, 5);
  }

  #row(name, frame, size) {
    return this.#file.array(name).subarray(frame * size, (frame + 1) * size);
  }
}
