// A rig's certificate in a few words: its verdict, and what keeps it from being good.

import { figure } from "../words.js";
import { state } from "./state.js";

/** Return the verdict on a rig as an element; null for a rig that was made without. */
export function verdictOf(summary) {
  const { verdict } = summary;
  return verdict ? state(verdict) : null;
}

/** Return what is not good about a rig, the worst first, as `findingList` shows it. */
export function rigFindings({ checks = [], warnings = [] }) {
  const failed = checks.filter(({ verdict }) => verdict !== "good");
  const found = failed.map(({ code, verdict, title, value, unit, worst, meaning, says, advice }) => ({
    code,
    severity: verdict === "bad" ? "error" : "warning",
    message: `${title}: ${value === null ? "no figure" : `${figure(value)} ${unit}`.trim()} in ${worst} (${says || meaning})`,
    advice,
  }));
  found.sort((a, b) => (b.severity === "error") - (a.severity === "error"));
  return [...found, ...warnings.map(({ code, message }) => ({ code, severity: "warning", message }))];
}
