// The subjects, newest first, with where each stands.

import { all, get } from "../api.js";
import { h, setText, show } from "../dom.js";
import { table } from "../parts/frame.js";
import { toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { count, when } from "../words.js";

const PAGE = 25; // each row asks for its scans and rigs

export async function mount(root) {
  const ending = new AbortController();
  const list = new SubjectList(ending.signal);
  root.append(...list.elements);
  await list.refresh();
  return () => ending.abort();
}

class SubjectList {
  constructor(signal) {
    this.signal = signal;
    this.cursors = [null];
    this.body = h("tbody");
    this.empty = h(
      "p",
      { class: "empty", hidden: true },
      "No subjects yet. ",
      h("a", { href: "/upload" }, "Upload scans"),
      " to add one.",
    );
    this.table = table(["Subject", "Scans", "Rigs", "Added"], this.body);
    this.newer = h("button", { type: "button", onclick: () => this.turn(-1) }, "Newer");
    this.older = h("button", { type: "button", onclick: () => this.turn(1) }, "Older");
    this.elements = [
      h(
        "div",
        { class: "head" },
        h("h1", { class: "grow" }, "Subjects"),
        h("a", { class: "button", href: "/upload" }, "Upload scans"),
      ),
      h("section", { class: "panel", "aria-label": "Subjects" }, this.table, this.empty),
      h("nav", { class: "row", "aria-label": "Pages of the list" }, this.newer, this.older),
    ];
  }

  async refresh() {
    const page = await get("/v1/subjects", { limit: PAGE, cursor: this.cursors.at(-1) }, this.signal);
    this.next = page.next;
    const rows = page.items.map((subject) => this.row(subject));
    show(
      this.body,
      rows.map(({ element }) => element),
    );
    this.table.hidden = !rows.length;
    this.empty.hidden = rows.length > 0;
    this.newer.hidden = this.cursors.length === 1;
    this.older.hidden = !page.next;
    this.describe(rows).catch(() => {}); // a row without its figures is still a way to the subject
  }

  turn(by) {
    if (by > 0) this.cursors.push(this.next);
    else this.cursors.pop();
    this.refresh().catch((error) => toast(sentence(error), "bad"));
  }

  row(subject) {
    const scans = h("td", {}, "…");
    const rigs = h("td", {}, "…");
    return {
      subject,
      scans,
      rigs,
      element: h(
        "tr",
        {},
        h("th", { scope: "row" }, h("a", { href: `/subjects/${subject.id}` }, subject.name)),
        scans,
        rigs,
        h("td", { class: "tight" }, when(subject.created_at)),
      ),
    };
  }

  /** Ask for each subject's scans and rigs, one after the other: the list is not urgent. */
  async describe(rows) {
    for (const { subject, scans, rigs } of rows) {
      const [captures, found] = await Promise.all([
        all(`/v1/subjects/${subject.id}/captures`, {}, this.signal),
        get("/v1/rigs", { subject_id: subject.id, limit: 100 }, this.signal),
      ]);
      setText(scans, standing(captures));
      show(
        rigs,
        found.items.length
          ? h(
              "a",
              { href: `/rigs/${found.items[0].id}` },
              found.items.length === 1 ? "Open" : `${found.items.length}, open the newest`,
            )
          : "none",
      );
    }
  }
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
