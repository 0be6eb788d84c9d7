// A job's reports of progress as curves, an attempt at a time.

import { h, show } from "../dom.js";
import { plot } from "./plot.js";

const CURVES = [
  { key: "mean_error_mm", title: "Mean error", unit: "mm" },
  { key: "residual", title: "Residual", unit: "" },
];
const PAUSE_MS = 250;
const LEAST_WIDTH = 340;

/** Collects reports; `element` shows their curves, if there is a figure in them. */
export class Progress {
  constructor() {
    this.attempts = new Map();
    this.curves = h("div", { class: "curves" });
    new ResizeObserver(() => this.curves.clientWidth !== this.drawnFor && this.drawSoon()).observe(
      this.curves,
    );
    this.choice = h("select", { onchange: () => this.draw() });
    this.choose = h("label", { class: "row", hidden: true }, "Attempt", this.choice);
    this.element = h(
      "section",
      { class: "panel", "aria-labelledby": "convergence", hidden: true },
      h("div", { class: "head" }, h("h2", { id: "convergence", class: "grow" }, "Convergence"), this.choose),
      this.curves,
    );
  }

  /** Take a report. */
  add(report) {
    const number = report.attempt;
    if (!this.attempts.has(number)) {
      this.attempts.set(number, []);
      this.choice.append(h("option", { value: number }, number));
      this.choice.value = number;
      this.choose.hidden = this.attempts.size < 2;
    }
    const reports = this.attempts.get(number);
    reports.push({ ...report, x: reports.length + 1 });
    this.drawSoon(); // hundreds arrive at once when a page is opened
  }

  drawSoon() {
    this.timer ??= setTimeout(() => this.draw(), PAUSE_MS);
  }

  draw() {
    this.timer = null;
    const reports = this.attempts.get(Number(this.choice.value)) ?? [];
    const curves = CURVES.filter(
      ({ key }) => reports.filter((report) => Number.isFinite(report[key])).length > 1,
    );
    this.element.hidden = !curves.length;
    this.drawnFor = this.curves.clientWidth;
    const width = this.widthOf(curves.length);
    if (!width) return; // not in the page: its size will be told when it is
    show(
      this.curves,
      curves.map(({ key, ...words }) =>
        plot(
          reports.map((report) => ({ x: report.x, y: report[key], phase: report.phase })),
          { ...words, width },
        ),
      ),
    );
  }

  /** Return how wide a curve can be in pixels: side by side where there is room. */
  widthOf(number) {
    const { clientWidth } = this.curves;
    const gap = parseFloat(getComputedStyle(this.curves).columnGap) || 0;
    const columns = clientWidth > LEAST_WIDTH * number + gap ? Math.max(number, 1) : 1;
    return Math.floor((clientWidth - gap * (columns - 1)) / columns);
  }
}
