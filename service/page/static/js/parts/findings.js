// What a check found, in words.

import { h } from "../dom.js";
import { state } from "./state.js";

/** Return a list of findings: how grave, what, and what would mend it. */
export function findingList(findings) {
  if (!findings.length) return h("p", {}, "Nothing to mend.");
  return h(
    "ul",
    { class: "findings" },
    findings.map(({ severity, message, advice }) =>
      h(
        "li",
        {},
        state(severity),
        h("div", {}, h("p", {}, sentence(message)), advice && h("p", { class: "fine" }, sentence(advice))),
      ),
    ),
  );
}

function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}
