// A line plot as inline SVG: how an error fell, report by report.

import { h, svg } from "../dom.js";
import { figure, plain } from "../words.js";

const TICKS = 5;

/**
 * Return a figure of `points` ({x, y, phase}) for a place `width` pixels wide; null if there are
 * fewer than two.
 *
 * The scale is logarithmic where the values span more than a factor of 30.
 */
export function plot(points, { title, unit, width }) {
  const drawn = points.filter(({ y }) => Number.isFinite(y));
  if (drawn.length < 2) return null;
  const box = room(width);
  const ys = drawn.map(({ y }) => y);
  const x = scale(drawn[0].x, drawn.at(-1).x, box.left, box.right);
  const y = vertical(Math.min(...ys), Math.max(...ys), box);
  const path = drawn
    .map((point, i) => `${i ? "L" : "M"}${x(point.x).toFixed(1)} ${y.at(point.y).toFixed(1)}`)
    .join("");
  const last = drawn.at(-1);
  const words = `from ${figure(ys[0])} to ${figure(last.y)}${unit ? ` ${unit}` : ""} in ${drawn.length} reports`;
  const { rem } = box;
  return h(
    "figure",
    { class: "plot" },
    h("figcaption", {}, h("strong", {}, title), h("span", { class: "fine" }, words)),
    svg(
      "svg",
      { width, height: box.height, role: "img", "aria-label": `${title}: ${words}` },
      y.ticks.map((value) => [
        svg("line", { class: "grid", x1: box.left, x2: box.right, y1: y.at(value), y2: y.at(value) }),
        svg(
          "text",
          { x: box.left - 0.5 * rem, y: y.at(value) + 0.3 * rem, "text-anchor": "end" },
          figure(value),
        ),
      ]),
      phases(drawn).map(({ phase, from }) => [
        svg("line", { class: "phase", x1: x(from), x2: x(from), y1: box.top - 0.4 * rem, y2: box.bottom }),
        svg("text", { x: x(from) + 0.3 * rem, y: box.top - 0.5 * rem }, plain(phase)),
      ]),
      svg("text", { x: box.left, y: box.height - 0.5 * rem }, `report ${drawn[0].x}`),
      svg("text", { x: box.right, y: box.height - 0.5 * rem, "text-anchor": "end" }, `${last.x}`),
      svg("path", { class: "curve", d: path }),
      svg("circle", { class: "end", cx: x(last.x), cy: y.at(last.y), r: 0.28 * rem }),
    ),
  );
}

/** Return where the curve goes in a figure of a width, with room for labels in the text's size. */
function room(width) {
  const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  const height = 14 * rem;
  return {
    rem,
    height,
    left: 3.7 * rem,
    right: width - 0.6 * rem,
    top: 1.5 * rem,
    bottom: height - 2.1 * rem,
  };
}

function scale(from, to, low, high) {
  const range = to - from || 1;
  return (value) => low + ((value - from) / range) * (high - low);
}

function vertical(low, high, { bottom, top }) {
  if (low > 0 && high / low > 30) {
    const [from, to] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
    const place = scale(from, to, bottom, top);
    const every = Math.ceil((to - from) / TICKS);
    const ticks = [];
    for (let power = from; power <= to; power += every) ticks.push(10 ** power);
    return { at: (value) => place(Math.log10(value)), ticks };
  }
  const start = low >= 0 && low < high / 2 ? 0 : low;
  const step = nice((high - start) / TICKS || Math.abs(high) / TICKS || 1);
  const from = Math.floor(start / step) * step;
  const to = Math.max(Math.ceil(high / step) * step, from + step);
  const ticks = [];
  for (let i = 0; from + i * step <= to * (1 + 1e-9); i++) ticks.push(from + i * step);
  return { at: scale(from, to, bottom, top), ticks };
}

/** Round a step up to 1, 2 or 5 times a power of ten. */
function nice(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= step * (1 - 1e-9));
}

/** Return where each phase begins, without those that have no room for a label. */
function phases(points) {
  const least = (points.at(-1).x - points[0].x) / 6;
  const found = [];
  for (const { x, phase } of points) {
    const previous = found.at(-1);
    const isNear = previous && x - previous.from < least;
    if (previous?.phase === phase || isNear || points.at(-1).x - x < least) continue;
    found.push({ phase, from: x });
  }
  return found;
}
