// The takes that live sessions of a rig have recorded, and the jobs that solve them exactly.

import * as api from "../../api.js";
import { h, show } from "../../dom.js";
import { kindsByName } from "../../library.js";
import { navigate } from "../../navigate.js";
import { MARKER_SET } from "../../parts/handed_on.js";
import { askForJob } from "../../parts/new_job.js";
import { doing } from "../../parts/toast.js";
import { sentence } from "../../parts/trouble.js";
import { upload } from "../../tus.js";
import { count, short, when } from "../../words.js";

const KIND = "live_session";
const SENT = "live_takes.npz";

/** What solves a take exactly, by the session's source: a kind of job, and the role that its file has. */
const EXACT = {
  markers: { kind: "fit_markers", role: "markers" },
  landmarks: { kind: "fit_markers", role: "markers" },
  points: { kind: "fit_sequence", role: "performance" },
  weights: { kind: "animate", role: "asset" },
};

/** A list of takes; `find()` reads it, `add(take)` is told of one that a running session has just recorded. */
export class LiveTakes {
  #rig;
  #signal;
  #list = h("ul", { class: "live-takes", "aria-label": "Takes" });
  #stored = [];
  #running = [];

  constructor(rig, signal) {
    this.#rig = rig;
    this.#signal = signal;
    this.element = h("section", { class: "stack", "aria-labelledby": "live-takes" },
      h("h3", { id: "live-takes" }, "Takes"), this.#list);
    this.#show();
  }

  /** Read the takes of the sessions that have ended. */
  async find() {
    const query = { subject_id: this.#rig.subject_id, kind: KIND, state: "succeeded" };
    try {
      const ended = (await api.all("/v1/jobs", query, this.#signal)).filter((job) => job.rig_id === this.#rig.id);
      const jobs = await Promise.all(ended.map(({ id }) => api.get(`/v1/jobs/${id}`, {}, this.#signal)));
      this.#stored = jobs.flatMap((job) => (job.result?.summary?.takes ?? []).flatMap((take) => {
        const artifact = job.result.artifacts.find(({ name }) => name === take.file);
        return artifact ? [{ job, take, artifact }] : [];
      }));
      const known = new Set(jobs.map(({ id }) => id));
      this.#running = this.#running.filter(({ session }) => !known.has(session));
      this.#show();
    } catch (error) {
      if (!this.#signal.aborted) show(this.#list, h("li", { class: "notice bad", role: "alert" }, sentence(error)));
    }
  }

  /** Show a take of a session that still runs. */
  add(session, take) {
    this.#running.push({ session, take });
    this.#show();
  }

  #show() {
    const rows = [
      ...this.#running.map(({ take }) => row(take, h("span", { class: "fine" }, "stored when the session ends"))),
      ...this.#stored.map(({ job, take, artifact }) => row(take, h("span", { class: "fine" }, when(job.finished_at)), this.#solve(job, take, artifact))),
    ];
    show(this.#list, rows.length ? rows : h("li", { class: "fine" }, "No take was recorded yet."));
  }

  #solve(job, take, artifact) {
    const button = h("button", {
      type: "button",
      onclick: () => doing(button, async () => {
        const solving = await askForJob(await this.#order(job, take, artifact));
        if (solving) navigate(`/jobs/${solving.id}`);
      }),
    }, "Solve exactly", h("span", { class: "unseen" }, ` ${take.name}`));
    return button;
  }

  /** Make a take a capture of the person, once, and return what is asked for then. */
  async #order(job, take, artifact) {
    const { kind, role } = EXACT[job.options.source];
    const name = nameOf(take, job);
    const captures = [(await this.#capture(name, artifact, role)).id];
    // what the session sent, for the job to tell how far it was off
    const sent = job.result.artifacts.some((each) => each.name === SENT) ? [{ job: job.id, artifact: SENT }] : [];
    const order = { kind, subject_id: this.#rig.subject_id, rig_id: this.#rig.id, captures, from_jobs: sent };
    if (kind === "fit_markers") {
      // the marker set that the session read: a capture, or what a check has left
      const left = (job.from_jobs ?? []).filter(({ artifact }) => artifact === MARKER_SET);
      return { ...order, from_jobs: [...left, ...sent], marker_set: left.length ? null : job.captures?.[0] ?? null };
    }
    if (kind === "fit_sequence") {
      const { rate } = (await kindsByName()).get(KIND).options.properties;
      return { ...order, options: { fps: job.options.rate ?? rate.default, head_motion: true } };
    }
    return { ...order, options: { scene: { recording: { asset: name } } } };
  }

  async #capture(name, artifact, role) {
    const path = `/v1/subjects/${this.#rig.subject_id}/captures`;
    const known = (await api.all(path, {}, this.#signal)).find((each) => each.name === name && each.role === role);
    if (known) return known;
    const content = await api.bytes(`/v1/artifacts/${artifact.id}`, { signal: this.#signal });
    const file = new File([content], artifact.name);
    const nothing = () => {};
    const id = await upload(file, { started: nothing, progress: nothing, waiting: nothing, signal: this.#signal });
    return api.post(path, { name, role, upload_id: id, registered: true }, this.#signal);
  }
}

function row(take, ...behind) {
  const about = `${count(take.frames, "frame")}, ${take.seconds.toFixed(1)} s`;
  return h("li", {}, h("strong", {}, take.name), h("span", { class: "fine" }, about), behind);
}

/** Return a take's name as a capture's: those of two sessions may be called alike. */
function nameOf({ file }, job) {
  return `${file.replace(/\.[^.]*$/, "")}_${short(job.id)}`;
}
