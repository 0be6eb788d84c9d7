// The queue: what runs now, and every other job, newest first; live.

import { get } from "../api.js";
import { announce, h, setText } from "../dom.js";
import { watch } from "../events.js";
import { applied, inLine, seconds } from "../jobs.js";
import { keyed } from "../keyed.js";
import { changed, kindsByName, names, scansOf, subjectName, subjectsById } from "../library.js";
import { askToCancel } from "../parts/cancel.js";
import { verdictOf } from "../parts/certificate.js";
import { panel, table } from "../parts/frame.js";
import { meter } from "../parts/meter.js";
import { refuse } from "../parts/refuse.js";
import { FINAL, state, verdictState, word } from "../parts/state.js";
import { toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { repeat } from "../repeat.js";
import { replaceQuery } from "../navigate.js";
import { span, time, when } from "../words.js";

const EVERY_MS = 3_000;
const PAGE = 50;
// A browser has six connections to a service for all its windows; streams must leave some.
const MOST_STREAMS = 2;
const ACTIVE = ["running", "canceling"];
const STATES = ["queued", "running", "canceling", "succeeded", "failed", "canceled"];

export async function mount(root, _params, query) {
  const ending = new AbortController();
  changed(); // others add subjects too
  const queue = new Queue(query, ending.signal, await kindsByName());
  root.append(...queue.elements);
  await repeat(
    () => queue.refresh(),
    EVERY_MS,
    ending.signal,
    (error) => toast(sentence(error), "bad"),
  );
  return () => ending.abort();
}

class Queue {
  constructor(query, signal, kinds) {
    this.signal = signal;
    this.kinds = kinds;
    this.filters = {
      state: query.get("state") ?? "",
      kind: query.get("kind") ?? "",
      subject_id: query.get("subject_id") ?? "",
    };
    this.cursors = [null];
    this.streams = new Map();
    this.states = new Map();
    this.active = [];

    this.count = h("p", { class: "fine grow" });
    this.runningBody = h("tbody");
    this.otherBody = h("tbody");
    this.showRunning = keyed(this.runningBody, (job) => runningRow(job, this.kinds));
    this.showOthers = keyed(this.otherBody, (job) => otherRow(job, this.kinds));
    this.running = panel(
      "running",
      "Running now",
      table(["State", "Job", "Subject", "Progress", "Since", "(Actions)"], this.runningBody, {
        class: "jobs",
      }),
    );
    this.empty = h("div", { class: "empty" });
    this.newer = h("button", { type: "button", onclick: () => this.turn(-1) }, "Newer");
    this.older = h("button", { type: "button", onclick: () => this.turn(1) }, "Older");
    const columns = ["State", "Job", "Subject", "Outcome", "Submitted", "Took"];
    this.table = table(columns, this.otherBody, { class: "jobs" });
    this.elements = [
      h("div", { class: "head" }, h("h1", {}, "Queue"), this.count, this.filterForm()),
      this.running,
      h("section", { class: "panel", "aria-label": "Jobs" }, this.table, this.empty),
      h("nav", { class: "row", "aria-label": "Pages of the list" }, this.newer, this.older),
    ];
  }

  filterForm() {
    const subjects = select("Subject", "subject_id", [["", "All subjects"]], this.filters, () =>
      this.refilter(),
    );
    const list = subjects.querySelector("select");
    subjectsById().then(
      (found) => {
        list.append(...[...names(found)].map(([id, name]) => h("option", { value: id }, name)));
        list.value = this.filters.subject_id;
      },
      () => {}, // the list of jobs says what is wrong
    );
    const states = STATES.map((key) => [key, word(key)]);
    const kinds = [...this.kinds.values()].map(({ kind, title }) => [kind, title]);
    return h(
      "form",
      { class: "row filters", role: "search", "aria-label": "Which jobs" },
      select("State", "state", [["", "All states"], ...states], this.filters, () => this.refilter()),
      select("Kind", "kind", [["", "All kinds"], ...kinds], this.filters, () => this.refilter()),
      subjects,
    );
  }

  refilter() {
    const given = Object.entries(this.filters).filter(([, value]) => value);
    replaceQuery(new URLSearchParams(given));
    this.cursors = [null];
    this.refresh().catch((error) => toast(sentence(error), "bad"));
  }

  turn(by) {
    if (by > 0) this.cursors.push(this.next);
    else this.cursors.pop();
    this.refresh().then(
      () => scrollTo(0, 0),
      (error) => toast(sentence(error), "bad"),
    );
  }

  /** Ask for what is shown; an answer that comes after the next question is dropped. */
  async refresh() {
    const asked = (this.asked = {});
    const { state: wanted, ...rest } = this.filters;
    const [usage, ...lists] = await Promise.all([
      get("/v1/usage", {}, this.signal),
      get("/v1/jobs", { ...this.filters, limit: PAGE, cursor: this.cursors.at(-1) }, this.signal),
      ...(wanted
        ? []
        : ACTIVE.map((key) => get("/v1/jobs", { ...rest, state: key, limit: 200 }, this.signal))),
    ]);
    if (asked !== this.asked) return;
    const [page, ...active] = lists;
    this.next = page.next;
    this.active = active.flatMap(({ items }) => items);
    const isActive = new Set(this.active.map(({ id }) => id));
    const others = page.items.filter(({ id }) => !isActive.has(id));
    this.showRunning(this.active);
    this.showOthers(others);
    this.tellStates([...this.active, ...others]);
    setText(this.count, `${usage.running.used} running, ${usage.queued.used} queued`);
    this.frame(others);
    this.follow();
  }

  frame(others) {
    this.running.hidden = !this.active.length;
    this.table.hidden = !others.length;
    this.empty.hidden = others.length > 0 || this.active.length > 0;
    setText(
      this.empty,
      Object.values(this.filters).some(Boolean)
        ? "No job is like that."
        : "No jobs yet. Upload scans, and their checks show up here.",
    );
    this.newer.hidden = this.cursors.length === 1;
    this.older.hidden = !this.next;
  }

  /** Stream the events of the first running jobs: their phases show at once. */
  follow() {
    const wanted = this.active.slice(0, MOST_STREAMS).map(({ id }) => id);
    for (const [id, ending] of this.streams) {
      if (!wanted.includes(id)) {
        ending.abort();
        this.streams.delete(id);
      }
    }
    for (const job of this.active) {
      if (!wanted.includes(job.id) || this.streams.has(job.id)) continue;
      const ending = new AbortController();
      this.streams.set(job.id, ending);
      watch(job.id, {
        after: job.last_event_id,
        signal: AbortSignal.any([this.signal, ending.signal]),
        tell: (event) => this.hear(job.id, event),
      })
        .catch(() => {})
        .finally(() => this.streams.get(job.id) === ending && this.streams.delete(job.id));
    }
  }

  hear(jobId, event) {
    this.active = this.active.map((job) => (job.id === jobId ? applied(job, event) : job));
    if (event.event === "state") this.refresh().catch(() => {});
    else this.showRunning(this.active);
  }

  /** Tell a screen reader which jobs came to an end or began; the first look says nothing. */
  tellStates(jobs) {
    for (const job of jobs) {
      const before = this.states.get(job.id);
      const isNews = before ? before !== job.state : this.hasLooked && job.state === "running";
      if (isNews && (job.state === "running" || FINAL.has(job.state))) {
        const title = this.kinds.get(job.kind)?.title ?? job.kind;
        subjectName(job.subject_id).then(
          (name) => announce(`${title}, ${name}: ${word(job.state)}`),
          () => {},
        );
      }
      this.states.set(job.id, job.state);
    }
    this.hasLooked = true;
  }
}

function select(label, name, options, filters, changed) {
  const element = h(
    "select",
    {
      name,
      onchange: () => {
        filters[name] = element.value;
        changed();
      },
    },
    options.map(([value, text]) => h("option", { value }, text)),
  );
  element.value = filters[name];
  return h("label", {}, h("span", { class: "unseen" }, label), element);
}

/** The cells that both tables have: state, what, of whom. */
function cells(job, kinds) {
  const badge = state(job.state);
  const subject = h("a", { href: `/subjects/${job.subject_id}` }, job.subject_name);
  const scans = h("span", { class: "fine" });
  // who shares a name has more words, which the list of jobs does not have
  subjectName(job.subject_id).then(
    (name) => setText(subject, name),
    () => {},
  );
  scansOf(job).then(
    (text) => setText(scans, text),
    () => {},
  );
  const link = h("a", { href: `/jobs/${job.id}` }, kinds.get(job.kind)?.title ?? job.kind);
  const priority = job.priority !== 0 && h("span", { class: "fine" }, `priority ${job.priority}`);
  return {
    badge,
    row: [
      h("td", { class: "tight" }, badge),
      h("th", { scope: "row" }, h("div", { class: "what" }, link, scans, priority)),
      h("td", {}, subject),
    ],
  };
}

function runningRow(job, kinds) {
  const { badge, row } = cells(job, kinds);
  const how = meter(job);
  const since = h("td", { class: "tight" });
  const stop = h(
    "button",
    { type: "button", onclick: () => askToCancel(job.id, kinds.get(job.kind)?.title ?? job.kind) },
    "Cancel",
  );
  return {
    element: h(
      "tr",
      { "data-job": job.id },
      row,
      h("td", {}, how),
      since,
      h("td", { class: "tight number" }, stop),
    ),
    update(next) {
      badge.set(next.state);
      how.set(next);
      refuse(stop, next.state === "running" ? null : "It is being stopped already");
      setText(since, next.started_at ? time(next.started_at) : "");
    },
  };
}

function otherRow(job, kinds) {
  const { badge, row } = cells(job, kinds);
  const outcome = h("td");
  const took = h("td", { class: "tight" });
  const bar = meter(job);
  let shown = null;
  return {
    element: h(
      "tr",
      { "data-job": job.id },
      row,
      outcome,
      h("td", { class: "tight" }, when(job.created_at)),
      took,
    ),
    update(next) {
      badge.set(next.state);
      bar.set(next);
      const lasted = seconds(next);
      setText(took, lasted === null ? "" : span(lasted));
      const key = `${next.state} ${next.queue_position} ${next.attempt}`;
      if (shown === key) return;
      shown = key;
      outcome.replaceChildren(...(ACTIVE.includes(next.state) ? [bar] : outcomeOf(next)));
    },
  };
}

/** What came of a job, or when it will begin, in a few words. */
function outcomeOf(job) {
  if (job.state === "queued") {
    const again = job.attempt ? `, after ${job.attempt} of ${job.max_attempts} attempts` : "";
    return [inLine(job) + again];
  }
  if (job.state === "failed")
    return [h("span", { class: "clip", title: job.error?.message }, job.error?.message)];
  if (job.state === "canceled")
    return [h("span", { class: "clip" }, job.cancel?.reason || "No reason given")];
  if (job.result.rig_id) {
    const open = h("a", { href: `/rigs/${job.result.rig_id}` }, "Open the rig");
    return [h("div", { class: "row" }, open, verdictOf(job.result))];
  }
  if (job.result.verdict) return [verdictState(job.result.verdict, job.kind)];
  return [];
}
