// A preview of what muscles do to the skin, by the reduced basis that the solver made and measured.

import { Container } from "./container.js";
import { millimetres } from "./face.js";

/** What `preview.bin` holds: sliders in [0, 1], and the skin as a quadratic map of them. */
export class Preview {
  #basis;
  #linear;
  #quadratic;

  constructor(buffer) {
    const file = new Container(buffer);
    const { controls, error_mm: error, presets } = file.header;
    this.controls = controls;
    this.error = error;
    this.presets = presets;
    const [count] = file.shape("basis");
    const basis = file.array("basis");
    const size = basis.length / count;
    this.#basis = Array.from({ length: count }, (_, r) => basis.subarray(r * size, (r + 1) * size));
    this.#linear = file.array("linear");
    this.#quadratic = file.array("quadratic");
  }

  /** Return the weight of each shape of the basis for slider values. */
  weights(values) {
    const count = values.length;
    const pairs = (count * (count + 1)) / 2;
    const tense = [...values.keys()].filter((i) => values[i] !== 0);
    return Float32Array.from(this.#basis, (_, r) => {
      let weight = 0;
      for (const [a, i] of tense.entries()) {
        weight += this.#linear[r * count + i] * values[i];
        // pairs i <= j lie row after row: row i begins after i rows of count, count - 1, ...
        const row = r * pairs + i * count - (i * (i - 1)) / 2 - i;
        for (let b = a; b < tense.length; b++) {
          const j = tense[b];
          weight += this.#quadratic[row + j] * values[i] * values[j];
        }
      }
      return weight;
    });
  }

  /** Return shape `r` of the basis, a displacement in mm. */
  shape(r) {
    return this.#basis[r];
  }

  /** Return control -> value where muscles (name -> contraction) and the jaw's five numbers are these. */
  valuesOf(contractions, jaw) {
    return new Map(this.controls.flatMap(({ name, muscle, full, by_jaw: byJaw }) => {
      const value = muscle ? contractions.get(muscle) / full : byJaw?.reduce((sum, each, i) => sum + each * jaw[i], 0);
      return value > 0 ? [[name, Math.min(value, 1)]] : [];
    }));
  }

  /** Return control -> value in a blend of expressions, name -> weight: as they are, where all are known. */
  valuesIn(expressions) {
    const presets = this.presets.filter(({ name }) => expressions.has(name));
    return new Map(this.controls.flatMap(({ name }, i) => {
      const value = presets.reduce((sum, preset) => sum + expressions.get(preset.name) * preset.values[i], 0);
      return value > 0 ? [[name, Math.min(value, 1)]] : [];
    }));
  }

  /** Return the approximation's error in words. */
  get errorInWords() {
    const { mean, max, poses } = this.error;
    return `approximation: mean ${millimetres(mean)} mm, at most ${millimetres(max)} mm on ${poses} unseen poses`;
  }

  /** Return the number of the slider of the same muscle on the other side of the face, or -1. */
  partner(number) {
    const { muscle } = this.controls[number];
    if (!muscle) return -1;
    const kind = withoutSide(muscle);
    return this.controls.findIndex((other, i) => i !== number && other.muscle && withoutSide(other.muscle) === kind);
  }
}

const SIDE = /(^|[\s_.])(left|right|l|r)(?=$|[\s_.])/gi;

/** Return a muscle's name without its side: "left buccinator" and "buccinator_l" are "buccinator". */
export function withoutSide(name) {
  return name.replace(SIDE, " ").replace(/[\s_.]+/g, " ").trim();
}
