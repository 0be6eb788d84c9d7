// Rates and spreads over the last seconds of a live session.

const WINDOW_MS = 2000;

/** What frames were like in the last two seconds, by this machine's clock. */
export class LiveFigures {
  #frames = [];
  #drawn = [];

  /** Take note of a frame that has come. */
  came(frame, now = performance.now()) {
    this.#frames.push({ at: now, number: frame.number, dropped: frame.dropped, solveMs: frame.solveMs });
    drop(this.#frames, now, ({ at }) => at);
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
    const times = this.#frames.map(({ solveMs }) => solveMs).sort((a, b) => a - b);
    return {
      sent: seconds ? (last.number - first.number) / seconds : NaN,
      followed: seconds ? (this.#frames.length - 1) / seconds : NaN,
      drawn: this.#drawn.length / (WINDOW_MS / 1000),
      p50: times[Math.floor(times.length / 2)] ?? NaN,
      p95: times[Math.floor(0.95 * times.length)] ?? NaN,
    };
  }
}

function drop(list, now, at) {
  let old = 0;
  while (old < list.length && now - at(list[old]) > WINDOW_MS) old++;
  list.splice(0, old);
}
