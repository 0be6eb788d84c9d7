// States of jobs and verdicts of checks: a sign, a word and a tone.

import { h, show, svg } from "../dom.js";

/** The states that a job stays in. */
export const FINAL = new Set(["succeeded", "failed", "canceled"]);

const SIGNS = {
  circle: () => svg("circle", { cx: 8, cy: 8, r: 6 }),
  arc: () => svg("path", { d: "M8 2a6 6 0 1 1-6 6" }),
  square: () => svg("rect", { x: 3, y: 3, width: 10, height: 10, rx: 1, "stroke-dasharray": "3 2.5" }),
  check: () => svg("path", { d: "M2.5 8.5 6.5 12.5 13.5 4" }),
  cross: () => svg("path", { d: "M3.5 3.5 12.5 12.5M12.5 3.5 3.5 12.5" }),
  slash: () => svg("path", { d: "M12.2 3.8a6 6 0 1 0 0 8.4 6 6 0 0 0 0-8.4ZM3.8 12.2 12.2 3.8" }),
  warning: () => svg("path", { d: "M8 2 14.5 13.5H1.5ZM8 6.5v3.2M8 11.4v.6" }),
  dash: () => svg("path", { d: "M3.5 8h9" }),
};

const LOOKS = {
  queued: ["circle", "Queued", "soft"],
  running: ["arc", "Running", "live"],
  canceling: ["square", "Canceling", "warn"],
  succeeded: ["check", "Succeeded", "good"],
  failed: ["cross", "Failed", "bad"],
  canceled: ["slash", "Canceled", "soft"],
  // verdicts of a check
  good: ["check", "Good", "good"],
  usable: ["warning", "Usable", "warn"],
  bad: ["cross", "Bad", "bad"],
  // parts of the service
  ok: ["check", "OK", "good"],
  // outcomes of an attempt
  lost: ["warning", "Lost", "warn"],
  released: ["dash", "Released", "soft"],
  // findings of a check
  error: ["cross", "Error", "bad"],
  warning: ["warning", "Warning", "warn"],
  info: ["dash", "Note", "soft"],
};

/** Return an element that shows a state; `state.set(key, words)` changes it. */
export function state(key, words = null) {
  const element = h("span", { class: "state" });
  let shown = null;
  element.set = (next, other = null) => {
    const [sign, word, tone] = LOOKS[next] ?? ["dash", next, "soft"];
    const text = other ?? word;
    if (shown === next + text) return;
    shown = next + text;
    element.dataset.tone = tone;
    element.dataset.state = next;
    show(element, icon(sign), text);
  };
  element.set(key, words);
  return element;
}

/** What to do about what a kind of job calls bad; a rig's certificate says it itself. */
const BAD = { check_scan: "Bad: scan again", check_markers: "Bad: it cannot be used" };

/** Return the words for the verdict of a job of a kind. */
export function verdictWords(verdict, kind) {
  return (verdict === "bad" && BAD[kind]) || word(verdict);
}

/** Return an element for the verdict of a job of a kind. */
export function verdictState(verdict, kind) {
  return state(verdict, verdictWords(verdict, kind));
}

/** Return a state's word. */
export function word(key) {
  return LOOKS[key]?.[1] ?? key;
}

function icon(sign) {
  return svg(
    "svg",
    {
      viewBox: "0 0 16 16",
      fill: "none",
      stroke: "currentColor",
      "stroke-width": 2,
      "stroke-linecap": "round",
      "stroke-linejoin": "round",
      "aria-hidden": "true",
      class: sign === "arc" ? "turns" : null,
    },
    SIGNS[sign](),
  );
}
