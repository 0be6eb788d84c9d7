// The findings of a check, in words.

import { h } from "../dom.js";
import { state } from "./state.js";

/** Findings that only tell, of what is red or orange in the picture: never nothing over a red patch. */
const IN_COLOUR = ["scan.gaps", "scan.spikes"];

/** Return a list of findings: how grave, what, and what would mend it. */
export function findingList(findings) {
  if (!findings.length) return h("p", {}, "Nothing to mend.");
  return h(
    "ul",
    { class: "findings" },
    findings.map(({ code, severity, message, advice }) =>
      h(
        "li",
        {},
        state(severity),
        h(
          "div",
          {},
          h("p", {}, sentence(message)),
          advice && h("p", { class: "fine" }, sentence(advice)),
          code && h("p", { class: "fine" }, h("code", {}, code)),
        ),
      ),
    ),
  );
}

/** Return what a check's picture shows in colour or the operator can do something about. */
export function toMend({ findings = [] }) {
  return findings.filter(({ code, severity }) => severity !== "info" || IN_COLOUR.includes(code));
}

/** Return how a scan was read and what of it was not judged, in a line each; null for older checks. */
export function judgedLines({ judged }) {
  if (!judged?.length) return null;
  const size = judged.find(({ about, judged: was }) => about === "size" && was);
  const open = judged.filter(({ judged: was }) => !was);
  return h(
    "div",
    { class: "fine" },
    size && h("p", {}, sentence(size.words)),
    open.length > 0 && h("p", {}, "Not judged: ", open.map(({ about, words }) => `${about} (${words})`).join("; "), "."),
  );
}

function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}
