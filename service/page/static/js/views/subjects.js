// The subjects, newest first, with where each stands.

import { all, get } from "../api.js";
import { h, setText, show } from "../dom.js";
import { verdictOf } from "../parts/certificate.js";
import { Paged } from "../parts/paged.js";
import { count, labelWords, short, when } from "../words.js";

const PAGE = 25; // each row asks for its scans and rigs

export async function mount(root) {
  const ending = new AbortController();
  const cells = new Map();
  const list = new Paged({
    path: "/v1/subjects",
    label: "Subjects",
    columns: ["Subject", "Scans", "Rigs", "Added"],
    row: (subject) => row(subject, cells),
    empty: ["No subjects yet. ", h("a", { href: "/upload" }, "Upload scans"), " to add one."],
    signal: ending.signal,
    size: PAGE,
    shown: (subjects) => describe(subjects, cells, ending.signal),
  });
  root.append(
    h(
      "div",
      { class: "head" },
      h("h1", { class: "grow" }, "Subjects"),
      h("a", { class: "button", href: "/upload" }, "Upload scans"),
    ),
    ...list.elements,
  );
  await list.refresh();
  return () => ending.abort();
}

function row({ id, name, labels, created_at: added }, cells) {
  const scans = h("td", {}, "…");
  const rigs = h("td", {}, "…");
  cells.set(id, { scans, rigs });
  return h(
    "tr",
    {},
    h(
      "th",
      { scope: "row" },
      h("a", { href: `/subjects/${id}` }, name),
      h("div", { class: "fine" }, short(id), labelWords(labels)),
    ),
    scans,
    rigs,
    h("td", { class: "tight" }, when(added)),
  );
}

/** Ask for each subject's scans and rigs, one after the other: the list is not urgent. */
async function describe(subjects, cells, signal) {
  for (const { id } of subjects) {
    const { scans, rigs } = cells.get(id);
    try {
      const [captures, made] = await Promise.all([
        all(`/v1/subjects/${id}/captures`, {}, signal),
        get("/v1/rigs", { subject_id: id, limit: 100 }, signal),
      ]);
      setText(scans, standing(captures));
      show(rigs, made.items.length ? newest(made.items) : "none");
    } catch {
      if (signal.aborted) return;
      for (const cell of [scans, rigs]) setText(cell, "not read"); // it is still a way to the subject
    }
  }
}

function newest(rigs) {
  const [rig] = rigs;
  const words = rigs.length === 1 ? "Open" : `${rigs.length}, open the newest`;
  return h("div", { class: "row" }, h("a", { href: `/rigs/${rig.id}` }, words), verdictOf(rig));
}

/** Say how many scans there are and what their checks said. */
function standing(captures) {
  if (!captures.length) return "none";
  const verdicts = ["bad", "usable", "good"].map((verdict) => [
    captures.filter(({ check }) => check?.verdict === verdict).length,
    verdict,
  ]);
  const told = verdicts.filter(([number]) => number).map(([number, verdict]) => `${number} ${verdict}`);
  return count(captures.length, "scan") + (told.length ? `: ${told.join(", ")}` : "");
}
