// A fitted sequence: the skin at any time of it, from the shapes and weights of `sequence.glb`.

import { blend } from "./face.js";
import { Glb } from "./glb.js";

/** The skin of a sequence, between frames by their shares; `frames` of them at `times` in s. */
export class Take {
  #glb;

  /** `markers` are its `MarkerTake`, of a take of markers, `contractions` those of its muscles, where it has them. */
  constructor(buffer, markers = null, contractions = null) {
    this.#glb = new Glb(buffer);
    this.markers = markers ?? null;
    this.contractions = contractions ?? null;
    this.times = this.#glb.tracks.times;
    this.frames = this.times.length;
  }

  /** Whether the sequence has the topology of a face with this many vertices. */
  fits(count) {
    return this.#glb.neutral.length === 3 * count;
  }

  /** Set `out` to the places at frame `at`, which may lie between two, over the neutral. */
  pose(out, neutral, at) {
    const { weights } = this.#glb.tracks;
    const count = this.#glb.shapes.length;
    const frame = Math.max(0, Math.min(this.frames - 1, Math.floor(at)));
    const next = Math.min(this.frames - 1, frame + 1);
    const share = at - frame;
    const mixed = Array.from({ length: weights ? count : 0 }, (_, k) => (
      (1 - share) * weights[frame * count + k] + share * weights[next * count + k]
    ));
    return blend(out, neutral, mixed, (k) => this.#glb.shapes[k]);
  }

  /** Return where a time in s is among the frames. */
  frameAt(time) {
    let frame = 0;
    while (frame < this.frames - 1 && this.times[frame + 1] <= time) frame++;
    if (frame === this.frames - 1) return frame;
    return frame + (time - this.times[frame]) / (this.times[frame + 1] - this.times[frame]);
  }
}
