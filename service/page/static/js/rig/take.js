// A sequence or an animation: the skin at any time of it, from the shapes, weights and joints of its GLB file.

import { blend } from "./face.js";
import { Glb } from "./glb.js";
import { placeOf } from "./track.js";

/** The skin of a take, between frames by their shares; `frames` of them at `times` in s. */
export class Take {
  #glb;

  /**
   * `times` are those of an animation's frames, whose file has no more keys than it needs; null: the
   * keys are the frames. `markers` are its `MarkerTake`, of a take of markers, `contractions` those
   * of its muscles, where it has them.
   */
  constructor(buffer, { times = null, markers = null, contractions = null } = {}) {
    this.#glb = new Glb(buffer);
    this.markers = markers;
    this.contractions = contractions;
    this.times = times ?? this.#glb.times;
    this.frames = this.times.length;
  }

  /** Whether a neck carries the skin: else it is in the head's own frame. */
  get isCarried() {
    return this.#glb.joints !== null;
  }

  /** Whether the take has the topology of a face with this many vertices. */
  fits(count) {
    return this.#glb.neutral.length === 3 * count;
  }

  /** Set `out` to the places at frame `at`. */
  pose(out, at) {
    const time = this.times[at];
    blend(out, this.#glb.neutral, this.#glb.weights?.at(time) ?? [], (k) => this.#glb.shapes[k]);
    this.#glb.joints?.carry(out, time);
  }

  /** Return where a time in s is among the frames. */
  frameAt(time) {
    return placeOf(this.times, time);
  }
}
