// Markers of a fitted take, frame by frame, from `markers.bin`.

import { Container } from "./container.js";

/** k labels and m muscles in some frames; places are flat x, y, z in mm, in the head's frame. */
export class MarkerTake {
  #file;
  #states;

  constructor(buffer) {
    this.#file = new Container(buffer);
    const { labels, muscles, states, status } = this.#file.header;
    this.labels = labels;
    this.muscles = muscles;
    this.status = status;
    this.frames = status.length;
    this.#states = states;
  }

  /** Return where the fitted face has the markers in a frame. */
  places(frame) {
    return this.#row("places", frame, 3 * this.labels.length);
  }

  /** Return how far off these each was seen, NaN where it was not. */
  off(frame) {
    return this.#row("off", frame, 3 * this.labels.length);
  }

  /** Return what became of a marker in a frame. */
  state(frame, marker) {
    return this.#states[this.#file.array("state")[frame * this.labels.length + marker]];
  }

  /** Whether a muscle is held in a frame. */
  isHeld(frame, muscle) {
    return this.#file.array("held")[frame * this.muscles.length + muscle] === 1;
  }

  #row(name, frame, size) {
    return this.#file.array(name).subarray(frame * size, (frame + 1) * size);
  }
}
