// One job: what it does, how far it is, what came of it, and what can be done about it.

import { contentOf, get, request } from "../api.js";
import { announce, h, joined, setText, show } from "../dom.js";
import { watch } from "../events.js";
import { applied, inLine, seconds } from "../jobs.js";
import { capturesById, kindsByName, subjectName } from "../library.js";
import { askToCancel } from "../parts/cancel.js";
import { fileTable } from "../parts/files.js";
import { panel, table } from "../parts/frame.js";
import { Log } from "../parts/log.js";
import { meter } from "../parts/meter.js";
import { askToRunAgain } from "../parts/new_job.js";
import { Progress } from "../parts/progress.js";
import { jobLinks, readersOf } from "../parts/readers.js";
import { refuse } from "../parts/refuse.js";
import { resultPanel } from "../parts/result.js";
import { FINAL, state, word } from "../parts/state.js";
import { doing, toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { repeat } from "../repeat.js";
import { navigate, title as nameWindow } from "../navigate.js";
import { plain, span, when } from "../words.js";

const NO_CONTENT = 204;
const EVERY_MS = 3_000; // what events do not tell: attempts, place in the queue, log

/** What the operator can do about errors that are not about the input. */
const ADVICE = {
  worker_lost:
    "The workers that took this job died. Run it again; if that happens again, tell whoever runs the service.",
  "solver.crash": "This is a fault of the solver, not of the scans. Report it with the job's id and its log.",
  "solver.killed":
    "The solver process was killed, most likely for want of memory. Run it again when less is running.",
  "solver.memory": "The job needs more memory than a solver may take (MYOFACE_SOLVER_MEMORY_MB).",
  "storage.full": "There is no room left for files. Make room, then run it again.",
};

/** Where an order to stop came from, by the names that the API and this page give themselves. */
const ORDERED = { api: "by a program", page: "on this page" };

export async function mount(root, { id }) {
  const ending = new AbortController();
  const { signal } = ending;
  const [job, kinds] = await Promise.all([get(`/v1/jobs/${id}`, {}, signal), kindsByName()]);
  const view = new JobView(job, kinds, signal);
  show(root, view.elements);
  view.set(job);
  view.describe();
  await repeat(
    () => view.refresh(),
    EVERY_MS,
    signal,
    (error) => (error.status === 404 ? view.isGone() : toast(sentence(error), "bad")),
  );
  listen(view, signal);
  return () => ending.abort();
}

/** Hear all events from the first: they are the curve. */
function listen(view, signal) {
  watch(view.job.id, { signal, tell: (event) => view.hear(event) }).catch(() => {}); // asking again and again goes on, and says what is wrong
}

class JobView {
  constructor(job, kinds, signal) {
    this.job = job;
    this.signal = signal;
    this.kind = kinds.get(job.kind);
    this.title = this.kind?.title ?? job.kind;
    this.badge = state(job.state);
    this.subject = h("a", { href: `/subjects/${job.subject_id}` }, "…");
    this.about = h("span", {}, "of ");
    this.cancel = h(
      "button",
      { type: "button", class: "danger", onclick: () => this.askToCancel() },
      "Cancel",
    );
    this.again = h(
      "button",
      { type: "button", onclick: () => doing(this.again, () => this.runAgain()) },
      "Run again",
    );
    this.now = h("div", { class: "stack" });
    this.meter = meter(job);
    this.newest = h("img", { alt: "The newest frame", class: "picture", hidden: true });
    this.progress = new Progress();
    this.log = new Log(job.id);
    this.result = h("div", { class: "stack" });
    this.facts = h("dl", { class: "facts" });
    this.attempts = h("tbody");
    this.elements = [
      h(
        "div",
        { class: "head" },
        h("h1", {}, this.title),
        this.badge,
        h("p", { class: "grow" }, this.about, this.subject),
        this.cancel,
        this.again,
      ),
      h(
        "div",
        { class: "columns" },
        h("div", { class: "stack" }, this.now, this.newest, this.result, this.progress.element, this.log.element),
        h(
          "div",
          { class: "stack" },
          panel("facts", "Job", this.facts),
          panel("parameters", "Parameters", parameters(this.kind, job.options)),
          panel("attempts", "Attempts", table(["(Number)", "Worker", "Took", "Outcome"], this.attempts)),
        ),
      ),
    ];
  }

  /** Put in names that have to be asked for. */
  describe() {
    subjectName(this.job.subject_id).then(
      (name) => {
        setText(this.subject, name);
        nameWindow(`${this.title}, ${name}`);
      },
      () => {},
    );
    capturesById(this.job.subject_id, this.job.captures).then(
      (found) => {
        const names = this.job.captures.map((id) => found.get(id)?.name ?? "a deleted scan");
        this.scans = names.join(", ");
        if (names.length === 1) setText(this.about, `${names[0]} of `);
        this.showFacts();
      },
      () => {},
    );
  }

  /** Tell which later jobs read what this one left. */
  async describeReaders() {
    this.readers = await readersOf(this.job.subject_id, this.job.id, this.signal);
    this.showFacts();
  }

  async refresh() {
    const wasOver = FINAL.has(this.job.state) && this.hasAll;
    if (wasOver) return;
    const [job] = await Promise.all([
      get(`/v1/jobs/${this.job.id}`, {}, this.signal),
      this.log.refresh(this.signal),
    ]);
    this.set(job);
    this.hasAll = FINAL.has(job.state);
    if (this.kind?.leaves === "animation") await this.showNewest();
  }

  /** Show the newest frame of a simulation until its result is there. */
  async showNewest() {
    if (this.job.state !== "running") {
      this.newest.hidden = true;
      return;
    }
    const response = await request(`/v1/jobs/${this.job.id}/frames/picture`, { signal: this.signal });
    if (response.status === NO_CONTENT) return;
    const before = this.newest.src;
    this.newest.src = URL.createObjectURL(await contentOf(response, this.signal, "blob"));
    URL.revokeObjectURL(before);
    this.newest.hidden = false;
  }

  hear(event) {
    if (event.event === "progress") this.progress.add(event.data);
    if (event.id <= this.job.last_event_id) return; // how it came to what is shown already
    const before = this.job;
    const next = applied(before, event);
    if (next.state !== before.state) {
      announce(`${this.title}: ${word(next.state)}`);
      this.refresh().catch(() => {});
    } else if (next.phase !== before.phase && next.phase) {
      announce(`${this.title}: ${plain(next.phase)}`);
    }
    if (!FINAL.has(next.state)) this.set(next);
  }

  set(job) {
    this.job = job;
    const isOver = FINAL.has(job.state);
    this.badge.set(job.state);
    this.cancel.hidden = isOver;
    refuse(this.cancel, job.state === "canceling" ? "It is being stopped already" : null);
    this.again.hidden = !isOver;
    this.meter.set(job);
    this.showNow();
    this.showFacts();
    this.showAttempts();
    if (isOver && !this.shownResult && job.finished_at) {
      this.shownResult = true;
      if (job.result?.artifacts.length) this.describeReaders().catch(() => {});
      show(
        this.result,
        resultPanel(job, this.signal),
        job.result?.artifacts.length && panel("files", "Files", fileTable(job.result.artifacts)),
      );
    }
  }

  showNow() {
    const { job } = this;
    const key = `${job.state} ${job.queue_position} ${job.attempt} ${job.error?.code} ${job.cancel?.reason}`;
    if (this.shownNow === key) return;
    this.shownNow = key;
    show(this.now, nowOf(job, this.meter));
  }

  showFacts() {
    const { job } = this;
    const lasted = seconds(job);
    facts(this.facts, {
      Scans: this.scans,
      Submitted: when(job.created_at),
      Started: job.started_at && when(job.started_at),
      Finished: job.finished_at && when(job.finished_at),
      Took: lasted === null ? null : span(lasted),
      Priority: job.priority ? String(job.priority) : null,
      Reads: job.from_jobs.length > 0 && handedOn(job.from_jobs),
      "Read by": this.readers?.length > 0 && h("span", {}, jobLinks(this.readers)),
      "Made again from": job.parent_id && h("a", { href: `/jobs/${job.parent_id}` }, "an earlier job"),
      "Kept until": job.retain_until && when(job.retain_until),
      Rig: job.rig_id && h("a", { href: `/rigs/${job.rig_id}` }, "the one it was made from"),
      Id: h("code", {}, job.id),
    });
  }

  showAttempts() {
    show(
      this.attempts,
      this.job.attempts.length
        ? this.job.attempts.map(attemptRow)
        : h("tr", {}, h("td", { colspan: 4, class: "fine" }, "No worker has taken it yet.")),
    );
  }

  askToCancel() {
    askToCancel(this.job.id, this.title).then((job) => job && this.set(job));
  }

  async runAgain() {
    const job = await askToRunAgain(this.job);
    if (job) navigate(`/jobs/${job.id}`);
  }

  isGone() {
    show(
      this.now,
      h(
        "div",
        { class: "notice warn", role: "alert" },
        h("p", {}, "This job was deleted with its subject or scan."),
      ),
    );
    this.cancel.hidden = this.again.hidden = true;
  }
}

/** The files of earlier jobs that a job reads, each with a link to its job. */
function handedOn(files) {
  return h("span", {}, joined(files.map(({ job, artifact }) => h("a", { href: `/jobs/${job}` }, artifact))));
}

/** What matters most now: how far it is, or why it ended. */
function nowOf(job, bar) {
  if (job.state === "queued") {
    return h("div", { class: "notice" }, h("p", {}, `${inLine(job)}.`));
  }
  if (job.state === "running") return h("section", { class: "panel", "aria-label": "Progress" }, bar);
  if (job.state === "canceling")
    return h("div", { class: "notice warn" }, h("p", {}, "It is being stopped."), reason(job));
  if (job.state === "canceled") return h("div", { class: "notice" }, h("h2", {}, "Canceled"), reason(job));
  if (job.state === "failed" && job.error) return failure(job);
  return null;
}

function reason({ cancel }) {
  if (!cancel) return null;
  const how = ORDERED[cancel.by] ?? `by ${cancel.by}`;
  return h("p", {}, `Asked for ${how}, ${when(cancel.requested_at)}. Reason: ${cancel.reason || "none given"}.`);
}

function failure({ error, attempt, max_attempts: most }) {
  const { code, message, ...context } = error;
  const places = Object.entries(context).filter(([, value]) => value !== null && typeof value !== "object");
  return h(
    "div",
    { class: "notice bad" },
    h("h2", {}, "Failed"),
    h("p", {}, message),
    ADVICE[code] && h("p", {}, ADVICE[code]),
    h(
      "p",
      { class: "fine" },
      [
        h("code", {}, code),
        ...places.map(([name, value]) => `${name} ${value}`),
        code === "worker_lost" ? `${attempt} of ${most} attempts` : null,
      ]
        .filter(Boolean)
        .flatMap((part) => [part, " · "])
        .slice(0, -1),
    ),
  );
}

/** Show facts in a list; texts change in place, so that a link among them keeps the focus. */
function facts(list, entries) {
  const given = Object.entries(entries).filter(([, value]) => value);
  const names = given.map(([name]) => name).join();
  if (list.dataset.names !== names) {
    list.dataset.names = names;
    show(
      list,
      given.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]),
    );
    return;
  }
  const places = list.querySelectorAll("dd");
  given.forEach(([, value], i) => typeof value === "string" && setText(places[i], value));
}

/** All options with what they were, those that were chosen in bold. */
function parameters(kind, given) {
  const known = Object.entries(kind?.options.properties ?? {});
  if (!known.length) return h("p", { class: "fine" }, "This kind of job has none.");
  return h(
    "dl",
    { class: "facts" },
    known.map(([name, rules]) => {
      const value = given[name] ?? rules.default ?? null;
      const text = value === null ? "automatic" : typeof value === "object" ? code(value) : String(value);
      return [
        h("dt", {}, plain(name)),
        h(
          "dd",
          {},
          name in given ? h("strong", {}, text) : text,
          rules.description && h("div", { class: "fine" }, rules.description),
        ),
      ];
    }),
  );
}

function code(value) {
  return h("pre", { tabindex: 0, "aria-label": "JSON" }, JSON.stringify(value, null, 2));
}

function attemptRow(attempt) {
  return h(
    "tr",
    {},
    h("th", { scope: "row", class: "tight" }, attempt.number),
    h("td", { class: "breaks" }, attempt.worker),
    h("td", { class: "tight" }, span(seconds(attempt))),
    h("td", { class: "tight" }, state(attempt.outcome ?? "running")),
  );
}
