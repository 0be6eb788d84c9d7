// The log of a solver: the last lines, following the end until somebody scrolls up.

import { get } from "../api.js";
import { h } from "../dom.js";

const MOST_LINES = 2_000;
const A_TIME = 1_000;
const NEAR_END_PX = 40;

/** A job's log; `element` shows it, `refresh(signal)` reads what is new. */
export class Log {
  constructor(jobId) {
    this.jobId = jobId;
    this.next = 0;
    this.attempt = null;
    this.dropped = h("p", { class: "fine", hidden: true }, "Earlier lines are not shown.");
    this.lines = h("pre", {
      class: "log",
      tabindex: 0,
      role: "log",
      "aria-live": "off",
      "aria-label": "Log",
    });
    this.none = h("p", { class: "fine" }, "Nothing was printed so far.");
    this.element = h(
      "section",
      { class: "panel", "aria-labelledby": "log" },
      h("h2", { id: "log" }, "Log"),
      this.none,
      this.dropped,
      this.lines,
    );
    this.lines.hidden = true;
  }

  /** Read all lines that are new. */
  async refresh(signal) {
    let page;
    do {
      const part = this.next ? { after: this.next, limit: A_TIME } : { tail: A_TIME };
      page = await get(`/v1/jobs/${this.jobId}/log`, part, signal);
      // two questions at a time may bring a line twice
      const lines = page.lines.filter(({ number }) => number > this.next);
      if (lines.length) this.add(lines);
      this.next = Math.max(this.next, page.next);
    } while (page.lines.length === A_TIME);
  }

  add(lines) {
    this.none.hidden = true;
    this.lines.hidden = false;
    const isAtEnd = this.lines.scrollHeight - this.lines.scrollTop - this.lines.clientHeight < NEAR_END_PX;
    if (this.attempt === null && lines[0].number > 1) this.dropped.hidden = false;
    for (const { attempt, text } of lines) {
      if (attempt !== this.attempt && (this.attempt !== null || attempt > 1)) {
        this.lines.append(h("b", {}, `— attempt ${attempt} —\n`));
      }
      this.attempt = attempt;
      this.lines.append(h("span", {}, `${text}\n`));
    }
    while (this.lines.childElementCount > MOST_LINES) {
      this.lines.firstChild.remove();
      this.dropped.hidden = false;
    }
    if (isAtEnd) this.lines.scrollTop = this.lines.scrollHeight;
  }
}
