// The heading of a rig, above its picture.

import { h } from "../dom.js";
import { rigFindings, verdictOf } from "../parts/certificate.js";
import { openPage, rigDownloads } from "../parts/files.js";
import { findingList } from "../parts/findings.js";
import { doing } from "../parts/toast.js";
import { count, figure, labelWords, short, span, when } from "../words.js";

const CERTIFICATE = "report.html";

/** Return the heading of a rig of a subject, with its figures and ways on; `buttons` stand before. */
export function heading(rig, subject, buttons = []) {
  const { train_mean_mm: train, test_mean_mm: test, muscles, inverted } = rig.summary;
  const facts = [
    ["certificate", verdictOf(rig.summary)],
    ["training", millimetres(train)],
    ["unseen", millimetres(test)],
    ["muscles", muscles],
    ["inverted tets", inverted],
    ["made", when(rig.created_at)],
    ["took", rig.seconds === null ? null : span(rig.seconds)],
    ["labels", labelWords(rig.labels).slice(2) || null],
    ["id", h("span", { title: rig.id }, short(rig.id))],
  ].filter(([, value]) => value !== null && value !== undefined);
  return h("header", { class: "stack" },
    h("div", { class: "head" },
      h("h1", { class: "grow" }, rig.name ? `${rig.name}, rig of ` : "Rig of ", h("a", { href: `/subjects/${subject.id}` }, subject.name)),
      buttons,
      certificate(rig),
      rigDownloads(rig),
      h("a", { class: "button", href: `/compare?a=${rig.id}` }, "Compare"),
      h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "Job and files")),
    h("div", { class: "rig-line" },
      h("dl", { class: "rig-facts" }, facts.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value)))),
      findings(rig.summary)),
    rig.summary.use && h("p", { class: "fine" }, rig.summary.use));
}

/** Return a button that opens the certificate in a window of its own. */
function certificate({ artifacts }) {
  const page = artifacts.find(({ name }) => name === CERTIFICATE);
  if (!page) return null;
  const button = h("button", { type: "button", onclick: () => doing(button, () => openPage(page)) }, "Certificate");
  return button;
}

/** Return what keeps a rig from being good, folded. */
function findings(summary) {
  const found = rigFindings(summary);
  return found.length > 0 && h("details", { class: "rig-findings" },
    h("summary", {}, `${count(found.length, "finding")} of the certificate`), h("div", { class: "panel" }, findingList(found)));
}

function millimetres(value) {
  return value === null || value === undefined ? null : `${figure(value)} mm`;
}
