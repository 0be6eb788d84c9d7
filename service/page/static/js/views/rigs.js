// The rigs of all subjects, newest first, with their verdicts.

import { h } from "../dom.js";
import { changed, subjectName } from "../library.js";
import { verdictOf } from "../parts/certificate.js";
import { Paged } from "../parts/paged.js";
import { figure, labelWords, short, span, when } from "../words.js";

export async function mount(root) {
  const ending = new AbortController();
  changed(); // others add subjects too
  const list = new Paged({
    path: "/v1/rigs",
    label: "Rigs",
    columns: ["Rig", "Subject", "Verdict", "Expressions", "Mean error", "Took", "Made"],
    row,
    empty: ["No rigs yet. A subject's page builds its model and fits expressions: see ", h("a", { href: "/subjects" }, "the subjects"), "."],
    signal: ending.signal,
  });
  root.append(h("h1", {}, "Rigs"), ...list.elements);
  await list.refresh();
  return () => ending.abort();
}

function row(rig) {
  const subject = h("a", { href: `/subjects/${rig.subject_id}` }, rig.subject_name);
  // who shares a name has more words, which the list of rigs does not have
  subjectName(rig.subject_id).then(
    (name) => subject.replaceChildren(name),
    () => {},
  );
  return h(
    "tr",
    {},
    h(
      "th",
      { scope: "row" },
      h("a", { href: `/rigs/${rig.id}` }, rig.name || "Open the rig"),
      h("div", { class: "fine" }, short(rig.id), labelWords(rig.labels)),
    ),
    h("td", {}, subject),
    h("td", { class: "tight" }, verdictOf(rig) ?? "not judged"),
    h("td", {}, rig.expressions.join(", ")),
    h("td", { class: "tight" }, rig.mean_mm === null ? "" : `${figure(rig.mean_mm)} mm`),
    h("td", { class: "tight" }, rig.seconds === null ? "" : span(rig.seconds)),
    h("td", { class: "tight" }, when(rig.created_at)),
  );
}
