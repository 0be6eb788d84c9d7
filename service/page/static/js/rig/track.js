// Values over time: as an animation's file has them, on straight lines between its keys.

/** `values` are rows of `width` numbers at `times` in s, which rise. */
export class Track {
  #values;
  #width;

  constructor(times, values, width) {
    this.times = times;
    this.#values = values;
    this.#width = width;
  }

  /** Return the row at a time; before the first key and after the last it is theirs. */
  at(time) {
    const place = placeOf(this.times, time);
    const before = Math.floor(place);
    const after = Math.min(before + 1, this.times.length - 1);
    const share = place - before;
    return Array.from({ length: this.#width }, (_, k) => (
      (1 - share) * this.#values[before * this.#width + k] + share * this.#values[after * this.#width + k]
    ));
  }
}

/** Return where a time lies among others that rise: 1.5 is half way from the second to the third. */
export function placeOf(times, time) {
  const last = times.length - 1;
  let low = 0;
  for (let high = last; low < high;) {
    const middle = Math.ceil((low + high) / 2);
    if (times[middle] <= time) low = middle;
    else high = middle - 1;
  }
  if (low === last) return last;
  return low + Math.max(0, time - times[low]) / (times[low + 1] - times[low]);
}
