// Followed frames of a live session, as they come by its WebSocket (docs/reference/live.md).

const MAGIC = "MYF<";
const HEADER = 36; // bytes
const VERSION = 1;
const HELD = 1;
const RESUMED = 2;
const GAP = 4; // the station's clock jumped

/** Reads frames by the `layout` of the session's ready message. */
export class FrameReader {
  #places = new Map();
  #size = 0;

  constructor(layout) {
    for (const { name, shape } of layout) {
      const size = shape.reduce((product, side) => product * side, 1);
      this.#places.set(name, [this.#size, this.#size + size]);
      this.#size += size;
    }
  }

  /** Return a frame, whose `array(name)` is null where it has none of the name; throws Error if `buffer` is none of this layout. */
  read(buffer) {
    const view = new DataView(buffer);
    const isFrame = buffer.byteLength === HEADER + 4 * this.#size
      && [...MAGIC].every((letter, i) => view.getUint8(i) === letter.charCodeAt(0));
    if (!isFrame || view.getUint16(4, true) !== VERSION) throw new Error("not a frame of this session");
    const numbers = new Float32Array(buffer, HEADER, this.#size);
    const flags = view.getUint16(6, true);
    return {
      isHeld: (flags & HELD) !== 0,
      hasOtherClock: (flags & (RESUMED | GAP)) !== 0,
      number: view.getUint32(8, true),
      seconds: view.getFloat64(12, true),
      solveMs: view.getFloat32(20, true),
      error: { p50: view.getFloat32(24, true), p95: view.getFloat32(28, true) },
      dropped: view.getUint32(32, true),
      array: (name) => (this.#places.has(name) ? numbers.subarray(...this.#places.get(name)) : null),
    };
  }
}
