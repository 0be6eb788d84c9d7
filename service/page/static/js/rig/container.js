// The binary files of a rig: named arrays behind a header in JSON (docs/guide/rig-view.md).

const MAGIC = "MYOV";
const FORMAT = 1;

/** The arrays of a file, read where they lie; half floats are unpacked when they are asked for. */
export class Container {
  #buffer;
  #unpacked = new Map();

  /** Throws Error if `buffer` is not such a file. */
  constructor(buffer) {
    const bytes = new Uint8Array(buffer);
    const text = new TextDecoder();
    if (text.decode(bytes.subarray(0, MAGIC.length)) !== MAGIC) throw new Error("not a file of a rig");
    const length = new DataView(buffer).getUint32(4, true);
    this.#buffer = buffer;
    this.header = JSON.parse(text.decode(bytes.subarray(8, 8 + length)));
    if (this.header.format !== FORMAT) throw new Error(`rig file format ${this.header.format}, not ${FORMAT}`);
  }

  /** Whether there is an array of this name. */
  has(name) {
    return name in this.header.arrays;
  }

  /** Return the shape of an array. */
  shape(name) {
    return this.header.arrays[name].shape;
  }

  /** Return an array, flat: a view of the file, or single floats for halves. */
  array(name) {
    const { dtype, shape, offset } = this.header.arrays[name];
    const size = shape.reduce((product, side) => product * side, 1);
    if (dtype === "float32") return new Float32Array(this.#buffer, offset, size);
    if (dtype === "uint32") return new Uint32Array(this.#buffer, offset, size);
    if (dtype === "uint8") return new Uint8Array(this.#buffer, offset, size);
    if (dtype !== "float16") throw new Error(`array ${name} is of kind ${dtype}`);
    if (!this.#unpacked.has(name)) {
      this.#unpacked.set(name, singles(new Uint16Array(this.#buffer, offset, size)));
    }
    return this.#unpacked.get(name);
  }
}

let table = null;

/** Return half floats, given as their bits, as single floats. */
export function singles(halves) {
  table ??= Float32Array.from({ length: 1 << 16 }, (_, bits) => single(bits));
  const out = new Float32Array(halves.length);
  for (let i = 0; i < out.length; i++) out[i] = table[halves[i]];
  return out;
}

function single(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}
