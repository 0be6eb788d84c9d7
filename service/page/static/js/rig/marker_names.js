// Names beside the dots of markers: as many as can be read, none over another or over a dot.

import { show, svg } from "../dom.js";

const HIGH = 14; // of a name, pixels
const DOT = 6; // radius that a dot takes
const GAPS = [9, 20, 34, 50, 72, 100, 135]; // between a dot and its name; with a line from the second on
const ANGLES = [0, 1, -1, 2, -2, 3, -3, 4].map((step) => (step * Math.PI) / 4); // from outward on
const LEAST_ROOM = 2; // between two names

/** Draws names over a stage; the list beside it has them for who cannot see. */
export class MarkerNames {
  element = svg("svg", { class: "marker-names", "aria-hidden": "true" });
  #widths = new Map();
  #measure = document.createElement("canvas").getContext("2d");

  /**
   * Show names of dots at `points` (x, y in pixels, null for one that is not seen) in a picture of `size`;
   * those in `first` are shown whatever they lie over.
   */
  show(labels, points, size, first = []) {
    const middle = size.width / 2;
    const taken = points.filter(Boolean).map(([x, y]) => square(x, y, DOT));
    const order = labels.map((_, k) => k).filter((k) => points[k])
      .sort((a, b) => first.includes(b) - first.includes(a) || away(b) - away(a));
    const drawn = [];
    for (const k of order) {
      const spot = this.#spot(labels[k], points[k], middle, size, taken, first.includes(k));
      if (!spot) continue;
      taken.push(spot.box, ...spot.line);
      drawn.push(svg("g", { class: first.includes(k) ? "chosen" : null },
        spot.gap > GAPS[0] && svg("line", { x1: points[k][0], y1: points[k][1], x2: spot.from[0], y2: spot.from[1] }),
        svg("text", { x: spot.box[0], y: spot.box[1] + HIGH - 3 }, labels[k])));
    }
    show(this.element, drawn);

    function away(k) {
      return Math.abs(points[k][0] - middle);
    }
  }

  /**
   * Return a free `box` for a name, its `gap` to the dot, where a line `from` the dot to it ends, and the `line` as
   * boxes; null if none is free.
   */
  #spot(label, [x, y], middle, size, taken, isFirst) {
    const wide = this.#width(label);
    const outward = x < middle ? -1 : 1;
    let nearest = null;
    for (const gap of GAPS) {
      for (const angle of ANGLES) {
        const [dx, dy] = [outward * Math.cos(angle), -Math.sin(angle)];
        const from = [x + gap * dx, y + gap * dy];
        const left = from[0] - wide * (0.5 - 0.5 * Math.sign(Math.round(2 * dx)));
        const top = from[1] - HIGH * (0.5 - 0.5 * dy);
        const box = [left, top, left + wide, top + HIGH];
        if (left < 0 || top < 0 || box[2] > size.width || box[3] > size.height) continue;
        const line = gap > GAPS[0] ? along([x, y], from) : [];
        const spot = { box, gap, from, line };
        if (!taken.some((other) => [box, ...line].some((each) => overlap(each, other)))) return spot;
        nearest ??= spot;
      }
    }
    return isFirst ? nearest : null;
  }

  #width(label) {
    if (!this.#widths.has(label)) {
      this.#measure.font = `600 11px ${getComputedStyle(this.element).fontFamily}`;
      this.#widths.set(label, this.#measure.measureText(label).width + 2);
    }
    return this.#widths.get(label);
  }
}

function square(x, y, half) {
  return [x - half, y - half, x + half, y + half];
}

/** Return boxes along a line, from beyond the dot that it begins at. */
function along([x, y], [toX, toY]) {
  const length = Math.hypot(toX - x, toY - y);
  const boxes = [];
  for (let at = DOT + 4; at < length; at += 4) boxes.push(square(x + ((toX - x) * at) / length, y + ((toY - y) * at) / length, 1));
  return boxes;
}

function overlap(a, b) {
  return a[0] < b[2] + LEAST_ROOM && b[0] < a[2] + LEAST_ROOM && a[1] < b[3] && b[1] < a[3];
}
