// A rig without sliders: why, the job that makes them, and how far that is.

import * as api from "../api.js";
import { announce, h, show } from "../dom.js";
import { inLine, seconds } from "../jobs.js";
import { meter } from "../parts/meter.js";
import { FINAL } from "../parts/state.js";
import { sentence } from "../parts/trouble.js";
import { repeat } from "../repeat.js";
import { span } from "../words.js";

const KIND = "build_preview";
const EVERY_MS = 3_000;

/**
 * Says whether the sliders of a rig are being made, or offers to. Once they should be there `ready` is called,
 * which returns whether they are.
 */
export class MissingPreview {
  element = h("div", { class: "stack" });
  #rig;
  #ready;
  #signal;

  constructor(rig, ready, signal) {
    this.#rig = rig;
    this.#ready = ready;
    this.#signal = signal;
  }

  /** Look for the rig's newest job that makes sliders. */
  async find() {
    const jobs = await api.all("/v1/jobs", { subject_id: this.#rig.subject_id, kind: KIND }, this.#signal);
    const newest = jobs.find((job) => job.rig_id === this.#rig.id);
    if (!newest) await this.#offer();
    else if (FINAL.has(newest.state)) await this.#end(newest);
    else await this.#follow(newest.id);
  }

  /** Offer to make the sliders, and say why the newest job, if there was one, made none. */
  async #offer(failed) {
    const why = failed?.error ? `There are no muscle sliders: ${failed.error.message}.` : "This rig has no muscle sliders yet.";
    const button = h("button", {
      type: "button",
      onclick: async () => {
        button.disabled = true;
        try {
          const order = { kind: KIND, subject_id: this.#rig.subject_id, rig_id: this.#rig.id };
          await this.#follow((await api.post("/v1/jobs", order, this.#signal)).id);
        } catch (error) {
          button.disabled = false;
          if (!this.#signal.aborted) show(this.element, h("p", { role: "alert" }, sentence(error)), button);
        }
      },
    }, "Make the sliders");
    const { items: [last] } = await api.get("/v1/jobs", { kind: KIND, state: "succeeded", limit: 1 }, this.#signal);
    const takes = last ? `the last time it took ${span(seconds(last))}` : "it takes two to ten minutes";
    show(this.element, h("p", {}, why), h("p", { class: "fine" }, `The solver simulates poses of the muscles: ${takes}.`), button);
  }

  /** Show how far the job is until it is over. */
  async #follow(id) {
    const over = new AbortController();
    const signal = AbortSignal.any([this.#signal, over.signal]);
    const state = h("div", { class: "fine" });
    const bar = meter({ attempts: [] });
    await repeat(async () => {
      const job = await api.get(`/v1/jobs/${id}`, {}, signal);
      if (FINAL.has(job.state)) {
        await this.#end(job);
        over.abort();
      } else if (job.state === "queued") show(state, `${inLine(job)}.`);
      else {
        bar.set(job);
        if (!bar.isConnected) show(state, bar);
      }
    }, EVERY_MS, signal, () => this.#offer());
    if (signal.aborted) return;
    show(this.element,
      h("p", { role: "status" }, "The muscle sliders are being made by ", h("a", { href: `/jobs/${id}` }, "a job"), ". They appear here once it is done."),
      state);
  }

  async #end(job) {
    if (job.state !== "succeeded" || !(await this.#ready())) await this.#offer(job);
    else announce("The muscle sliders are ready");
  }
}
