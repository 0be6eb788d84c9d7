// Faces in glTF as this product writes them: one mesh of one primitive, morph targets, a chain of joints that turn, one
// animation, arrays without strides. Metres to mm. They are blended in flat arrays, as expressions are, for heat maps and
// marks on the skin; files with materials and images are three.js's to read (studio/model.js).

import { Joints } from "./joints.js";
import { Track } from "./track.js";

const MAGIC = 0x46546c67;
const JSON_CHUNK = 0x4e4f534a;
/** Millimetres in a file's unit. */
export const MM = 1000;
const WIDTH = { SCALAR: 1, VEC3: 3, VEC4: 4, MAT4: 16 };
/** Arrays of the types of numbers in a file. */
const ARRAYS = {
  5120: Int8Array, 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array,
};
/** What of whole numbers stands for 1, where they are parts of it (KHR_mesh_quantization). */
const ONE = { 5120: 127, 5121: 255, 5122: 32767, 5123: 65535 };

/** A GLB file: its neutral and its shapes as flat x, y, z in mm, how they are animated, and joints that carry them. */
export class Glb {
  #json;
  #binary;

  constructor(buffer) {
    const words = new DataView(buffer);
    const isGlb = buffer.byteLength > 20 && words.getUint32(0, true) === MAGIC && words.getUint32(16, true) === JSON_CHUNK;
    if (!isGlb) throw new Error("not a GLB file");
    const length = words.getUint32(12, true);
    this.#json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
    this.#binary = { buffer, start: 20 + length + 8 };
    const [mesh] = this.#json.meshes;
    const [{ attributes, targets = [] }] = mesh.primitives;
    this.neutral = this.#accessor(attributes.POSITION).map((value) => MM * value);
    this.shapes = targets.map(({ POSITION }) => this.#accessor(POSITION).map((value) => MM * value));
    /** The keys of what moves first, in s. */
    this.times = this.#times();
    const face = this.#json.nodes.findIndex((node) => node.mesh === 0);
    /** The shapes' weights over time (`Track`), null where nothing moves. */
    this.weights = this.#track(face, "weights", this.shapes.length);
    /** What carries the skin after its shapes (`Joints`), null without a neck. */
    this.joints = this.#joints(this.#json.nodes[face]?.skin, attributes);
  }

  #times() {
    const [animation] = this.#json.animations ?? [];
    return animation ? this.#accessor(animation.samplers[0].input) : new Float32Array([0]);
  }

  #joints(number, attributes) {
    if (number === undefined) return null;
    const { joints, inverseBindMatrices } = this.#json.skins[number];
    const back = this.#accessor(inverseBindMatrices);
    return new Joints({
      rest: joints.map((_, k) => [12, 13, 14].map((entry) => -MM * back[16 * k + entry])),
      turns: joints.map((node) => this.#track(node, "rotation", WIDTH.VEC4)),
      bones: this.#accessor(attributes.JOINTS_0),
      shares: this.#accessor(attributes.WEIGHTS_0),
    });
  }

  /** Return what a property of a node does, `width` numbers of it; null where it is still. */
  #track(node, path, width) {
    const [animation] = this.#json.animations ?? [];
    const channel = animation?.channels.find(({ target }) => target.node === node && target.path === path);
    if (!channel) return null;
    const { input, output } = animation.samplers[channel.sampler];
    return new Track(this.#accessor(input), this.#accessor(output), width);
  }

  /** Return an accessor's values; what a sparse one leaves out is zero. */
  #accessor(number) {
    const { count, type, componentType: kind, normalized, bufferView, byteOffset = 0, sparse } = this.#json.accessors[number];
    const width = WIDTH[type];
    const values = sparse ? this.#sparse(sparse, kind, count, width) : this.#view(bufferView, byteOffset, kind, count * width);
    return normalized ? Float32Array.from(values, (value) => value / ONE[kind]) : values;
  }

  #sparse({ count: given, indices, values }, kind, count, width) {
    const out = new ARRAYS[kind](count * width);
    const places = this.#view(indices.bufferView, indices.byteOffset ?? 0, indices.componentType, given);
    const found = this.#view(values.bufferView, values.byteOffset ?? 0, kind, given * width);
    places.forEach((place, i) => out.set(found.subarray(width * i, width * (i + 1)), width * place));
    return out;
  }

  #view(number, offset, kind, length) {
    const { byteOffset = 0 } = this.#json.bufferViews[number];
    return new ARRAYS[kind](this.#binary.buffer, this.#binary.start + byteOffset + offset, length);
  }
}
