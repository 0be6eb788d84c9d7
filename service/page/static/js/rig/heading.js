// What a rig is, above its picture.

import { h } from "../dom.js";
import { figure, when } from "../words.js";

/** Return the heading of a rig of a subject, with its figures and ways on; `buttons` stand before. */
export function heading(rig, subject, buttons = []) {
  const { train_mean_mm: train, test_mean_mm: test, muscles, inverted } = rig.summary;
  const facts = [
    ["training", millimetres(train)],
    ["unseen", millimetres(test)],
    ["muscles", muscles],
    ["inverted tets", inverted],
  ].filter(([, value]) => value !== null && value !== undefined);
  return h("header", { class: "head rig-head" },
    h("h1", {}, "Rig of ", h("a", { href: `/subjects/${subject.id}` }, subject.name)),
    h("dl", { class: "rig-facts grow" }, facts.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value)))),
    h("span", { class: "fine" }, when(rig.created_at)),
    buttons,
    h("a", { class: "button", href: `/compare?a=${rig.id}` }, "Compare"),
    h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "Job and files"));
}

function millimetres(value) {
  return value === null || value === undefined ? null : `${figure(value)} mm`;
}
