// A fitted face as numbers: its neutral, its expressions and the scans they were fitted to.

import { Container } from "./container.js";

const STILL = [-0.06, 0.02]; // of files that do not say between which contractions a muscle holds still

/** What `view.bin` holds. Places are flat arrays of x, y, z in mm. */
export class Face {
  #file;

  constructor(buffer) {
    this.#file = new Container(buffer);
    // a file from before compartments has whole muscles only
    const { expressions, muscles, wholes = muscles, still = STILL, sagittal } = this.#file.header;
    this.expressions = expressions;
    this.muscles = muscles;
    this.wholes = wholes;
    this.still = still;
    this.neutral = this.#file.array("neutral");
    this.faces = this.#file.array("faces");
    /** The plane that takes each side to the other: a point `at` in it, and the way `across`, of length 1. */
    this.sagittal = sagittal ?? { at: [0, 0, 0], across: [1, 0, 0] };
    this.count = this.neutral.length / 3;
    this.names = expressions.map((expression) => expression.name);
    this.hasScans = expressions.some((_, k) => this.#file.has(`scan/${k}`));
  }

  /** Return how the fitted skin of expression `k` lies off the neutral. */
  skin(k) {
    return this.#file.array(`skin/${k}`);
  }

  /** Return how the scan of expression `k` lies off the neutral, null without a scan. */
  scan(k) {
    return this.#file.has(`scan/${k}`) ? this.#file.array(`scan/${k}`) : null;
  }

  /** Return the distance of fit and scan per vertex, NaN where nothing was seen. */
  error(k) {
    return this.#file.array(`error/${k}`);
  }

  /** Return the muscles that a name means: its own, or all compartments of a whole. */
  meant(name) {
    return this.muscles.filter((muscle, m) => name === muscle || name === this.wholes[m]);
  }

  /** Return how much each muscle contracts in expression `k`: the part of its fibres' length; NaN where unknown. */
  contractions(k) {
    const count = this.muscles.length;
    return this.#file.array("activation").subarray(k * count, (k + 1) * count).map((stretch) => 1 - stretch);
  }

  /** Return what a muscle has of values, one a muscle; a whole has that of its compartment with most. */
  of(name, values) {
    const known = this.meant(name).map((muscle) => values[this.muscles.indexOf(muscle)]).filter(Number.isFinite);
    return known.length ? Math.max(...known) : NaN;
  }

  /** Return the greatest distance per vertex over all expressions, NaN where nothing was seen. */
  worst() {
    const worst = new Float32Array(this.count).fill(NaN);
    for (let k = 0; k < this.names.length; k++) {
      const error = this.error(k);
      for (let i = 0; i < worst.length; i++) if (!(worst[i] >= error[i])) worst[i] = error[i];
    }
    return worst;
  }
}

/**
 * Set `out` to `base` and the weighted sum of fields, each `field(k)` of the size of `base`.
 *
 * A field that is null adds nothing.
 */
export function blend(out, base, weights, field) {
  out.set(base);
  for (let k = 0; k < weights.length; k++) {
    const weight = weights[k];
    const change = weight === 0 ? null : field(k);
    if (change) for (let i = 0; i < out.length; i++) out[i] += weight * change[i];
  }
  return out;
}

/** Return the lengths of the differences of places `a` and `b`, per vertex. */
export function distances(a, b) {
  const out = new Float32Array(a.length / 3);
  for (let i = 0, j = 0; i < out.length; i++, j += 3) {
    out[i] = Math.hypot(a[j] - b[j], a[j + 1] - b[j + 1], a[j + 2] - b[j + 2]);
  }
  return out;
}

/** Return mean, 95th percentile and greatest of the values that are numbers; null without any. */
export function figures(values) {
  const known = values.filter(Number.isFinite).sort();
  if (known.length === 0) return null;
  return {
    mean: known.reduce((sum, value) => sum + value, 0) / known.length,
    p95: known[Math.min(known.length - 1, Math.floor(0.95 * known.length))],
    max: known[known.length - 1],
  };
}

/** Return a distance as text, a dash where there is none. */
export function millimetres(value) {
  return Number.isFinite(value) ? value.toFixed(2) : "–";
}
