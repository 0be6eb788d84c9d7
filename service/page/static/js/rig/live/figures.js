// Rates and spreads over the last seconds of a live session.

const WINDOW_MS = 2000;
const WAY_MS = 5000; // of frames whose way here is compared

/** What frames were like in the last seconds, by this machine's clock. */
export class LiveFigures {
  #frames = [];
  #ways = [];
  #drawn = [];

  /** Take note of a frame that has come. */
  came(frame, now = performance.now()) {
    this.#frames.push({ at: now, number: frame.number, dropped: frame.dropped, solveMs: frame.solveMs });
    drop(this.#frames, now, ({ at }) => at);
    if (frame.hasOtherClock) this.#ways = [];
    this.#ways.push({ at: now, ms: now - 1000 * frame.seconds, solveMs: frame.solveMs });
    drop(this.#ways, now, ({ at }) => at, WAY_MS);
  }

  /** Take note of a drawing. */
  drawn(now = performance.now()) {
    this.#drawn.push(now);
    drop(this.#drawn, now, (at) => at);
  }

  /** Return frames a second that the station sends, that were followed and that are drawn, and ms that following takes. */
  now(now = performance.now()) {
    drop(this.#frames, now, ({ at }) => at);
    drop(this.#drawn, now, (at) => at);
    const [first, last] = [this.#frames[0], this.#frames.at(-1)];
    const seconds = last && (last.at - first.at) / 1000;
    const times = spread(this.#frames.map(({ solveMs }) => solveMs));
    return {
      sent: seconds ? (last.number - first.number) / seconds : NaN,
      followed: seconds ? (this.#frames.length - 1) / seconds : NaN,
      drawn: this.#drawn.length / (WINDOW_MS / 1000),
      p50: times.p50,
      p95: times.p95,
      way: this.#way(now),
    };
  }

  /**
   * Return ms from a frame's capture to its face here, at least, over the last five seconds: the two
   * clocks are not set by each other, so that the quickest frame counts as if only following it had
   * taken time.
   */
  #way(now) {
    drop(this.#ways, now, ({ at }) => at, WAY_MS);
    const begun = Math.min(...this.#ways.map(({ ms, solveMs }) => ms - solveMs));
    return spread(this.#ways.map(({ ms }) => ms - begun));
  }
}

function spread(values) {
  const sorted = values.sort((a, b) => a - b);
  const at = (share) => sorted[Math.floor(share * sorted.length)] ?? NaN;
  return { p50: at(0.5), p95: at(0.95) };
}

function drop(list, now, at, ms = WINDOW_MS) {
  let old = 0;
  while (old < list.length && now - at(list[old]) > ms) old++;
  list.splice(0, old);
}
