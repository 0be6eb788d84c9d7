// A set of files dropped together: sent file by file, then added as one batch, which is followed to its end.

import { contentOf, get, request } from "../api.js";
import { h, show } from "../dom.js";
import { newId } from "../jobs.js";
import { capturesById, changed } from "../library.js";
import { repeat } from "../repeat.js";
import { state } from "./state.js";

const EVERY_MS = 3_000;
const IN_THE_WAY = ["capture.name_taken", "capture.neutral_exists"];

/** Rows (`ScanRow`) of one subject; `order` is {subjectId, registered, options, then}. */
export class Session {
  #rows;
  #order;
  #sent = null;

  constructor(rows, order) {
    this.#rows = rows;
    this.#order = order;
    this.element = h("div", { class: "notice", hidden: true });
    for (const row of rows) row.wait(order);
  }

  /** How many files are still to be sent. */
  get left() {
    return this.#with("waiting").length;
  }

  /** Whether a row is one of this session's. */
  has(row) {
    return this.#rows.includes(row);
  }

  /** Leave a row out; returns whether the others, which waited for it, can be added now. */
  drop(row) {
    this.#rows = this.#rows.filter((other) => other !== row);
    return this.#with("sent").length > 0 && !this.left && !this.#with("failed").length;
  }

  /** Have the rows that failed wait once more. */
  again() {
    for (const row of this.#with("failed")) row.wait(this.#order);
  }

  /**
   * Send the files, one after the other, then make scans of them, in one call.
   *
   * While one has failed the others wait: it is tried again or left out, for a set is one batch.
   */
  async run(told) {
    for (let [row] = this.#with("waiting"); row; [row] = this.#with("waiting")) {
      told();
      await row.send();
    }
    if (this.#with("failed").length) return;
    const arrived = this.#with("sent");
    if (!arrived.length) return;
    try {
      const batch = await this.#add(arrived);
      changed(this.#order.subjectId);
      for (const row of arrived) row.take(batch.scans.find(({ name }) => name === row.capture.name));
      if (batch.then.length) this.#follow(batch);
    } catch (error) {
      const row = await this.#inTheWay(error, arrived).catch(() => null);
      for (const each of row ? [row] : arrived) each.fail(error);
    }
  }

  #with(stage) {
    return this.#rows.filter((row) => row.stage === stage);
  }

  /** Ask for the batch; asked twice for the same, after an answer that was lost, there is one. */
  async #add(rows) {
    const { subjectId, options, then } = this.#order;
    const body = JSON.stringify({
      subject_id: subjectId,
      captures: rows.map(({ capture }) => capture),
      then,
      options: { check_scan: options, ...(then.includes("register") ? { register_scan: options } : {}) },
    });
    if (this.#sent?.body !== body) this.#sent = { body, key: newId() };
    const headers = { "Content-Type": "application/json", "Idempotency-Key": this.#sent.key };
    return contentOf(await request("/v1/batches", { method: "POST", body, headers }));
  }

  /** Return the row that an earlier scan of the subject keeps out, null if that is not the error. */
  async #inTheWay({ code, document: problem }, rows) {
    if (!IN_THE_WAY.includes(code)) return null;
    if (code === "capture.neutral_exists") return rows.find(({ capture }) => capture.role === "neutral") ?? null;
    const earlier = await capturesById(this.#order.subjectId, [problem.capture_id]);
    const name = earlier.get(problem.capture_id)?.name;
    return rows.find(({ capture }) => capture.name === name) ?? null;
  }

  #follow(batch) {
    this.element.hidden = false;
    this.#show(batch);
    const ending = new AbortController();
    const ask = async () => {
      const now = await get(`/v1/batches/${batch.id}`, {}, ending.signal);
      this.#show(now);
      if (now.state !== "running") ending.abort();
    };
    repeat(ask, EVERY_MS, ending.signal).catch(() => {}); // its jobs are in the queue, whatever is shown here
  }

  #show({ state: key, scans, model, fit, error }) {
    const registrations = scans.map(({ registration }) => registration).filter(Boolean);
    const done = registrations.filter((each) => each.state === "succeeded").length;
    show(
      this.element,
      h(
        "div",
        { class: "row" },
        h("strong", {}, "The session"),
        state(key),
        registrations.length > 0 && `${done} of ${registrations.length} scans registered`,
        model && step("the model", model),
        fit && step("the rig", fit),
        fit?.rig_id && h("a", { class: "button", href: `/rigs/${fit.rig_id}` }, "Open the rig"),
      ),
      error && h("p", {}, error.message),
      scans
        .filter(({ left_out: why }) => why)
        .map(({ name, left_out: why }) => h("p", { class: "fine" }, `${name} is left out: ${why}`)),
    );
  }
}

function step(name, { job_id: job, state: key }) {
  return h("span", {}, h("a", { href: `/jobs/${job}` }, name), " ", state(key));
}
