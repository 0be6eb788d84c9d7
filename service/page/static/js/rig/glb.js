// Faces in glTF as this product writes them: one mesh, morph targets, one animation. Metres to mm.

const MAGIC = 0x46546c67;
const JSON_CHUNK = 0x4e4f534a;
const MM = 1000;
const FLOAT = 5126;
const UNSIGNED_SHORT = 5123;
const WIDTH = { SCALAR: 1, VEC3: 3, VEC4: 4 };

/** A GLB file: its neutral and its shapes as flat x, y, z in mm, and the tracks of its animation. */
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
    this.tracks = this.#tracks();
  }

  /** Return `times` in s and, where they are animated, `weights`, `rotation` and `translation`. */
  #tracks() {
    const [animation] = this.#json.animations ?? [];
    if (!animation) return { times: new Float32Array([0]) };
    const tracks = { times: this.#accessor(animation.samplers[0].input) };
    for (const { sampler, target } of animation.channels) {
      tracks[target.path] = this.#accessor(animation.samplers[sampler].output);
    }
    return tracks;
  }

  /** Return an accessor's values; what a sparse one leaves out is zero. */
  #accessor(number) {
    const { count, type, bufferView, byteOffset = 0, sparse } = this.#json.accessors[number];
    const width = WIDTH[type];
    if (!sparse) return this.#view(bufferView, byteOffset, FLOAT, count * width);
    const out = new Float32Array(count * width);
    const { indices, values } = sparse;
    const places = this.#view(indices.bufferView, indices.byteOffset ?? 0, indices.componentType, sparse.count);
    const given = this.#view(values.bufferView, values.byteOffset ?? 0, FLOAT, sparse.count * width);
    places.forEach((place, i) => out.set(given.subarray(width * i, width * (i + 1)), width * place));
    return out;
  }

  #view(number, offset, kind, length) {
    const { byteOffset = 0 } = this.#json.bufferViews[number];
    const kinds = { [FLOAT]: Float32Array, [UNSIGNED_SHORT]: Uint16Array };
    return new (kinds[kind] ?? Uint32Array)(this.#binary.buffer, this.#binary.start + byteOffset + offset, length);
  }
}
