// A job's reports of progress as curves, an attempt at a time.

import { h, show } from "../dom.js";
import { plot } from "./plot.js";

const CURVES = [
  { key: "mean_error_mm", title: "Mean error", unit: "mm" },
  { key: "residual", title: "Residual", unit: "" },
];
const PAUSE_MS = 250;

/** Collects reports; `element` shows their curves, if there is a figure in them. */
export class Progress {
  constructor() {
    this.attempts = new Map();
    this.curves = h("div", { class: "curves" });
    this.choice = h("select", { onchange: () => this.draw() });
    this.choose = h("label", { class: "row", hidden: true }, "Attempt", this.choice);
    this.element = h("section", { class: "panel", "aria-labelledby": "convergence", hidden: true },
      h("div", { class: "head" }, h("h2", { id: "convergence", class: "grow" }, "Convergence"), this.choose), this.curves);
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
    // hundreds arrive at once when a page is opened
    this.timer ??= setTimeout(() => this.draw(), PAUSE_MS);
  }

  draw() {
    this.timer = null;
    const reports = this.attempts.get(Number(this.choice.value)) ?? [];
    const drawn = CURVES.map(({ key, ...words }) =>
      plot(reports.map((report) => ({ x: report.x, y: report[key], phase: report.phase })), words)).filter(Boolean);
    this.element.hidden = !drawn.length;
    show(this.curves, drawn);
  }
}
