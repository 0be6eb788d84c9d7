// One file on its way: uploading, becoming a scan, being checked, its verdict.

import { ApiProblem, get } from "../api.js";
import { announce, h, setText, show } from "../dom.js";
import * as interrupted from "../interrupted.js";
import { inLine } from "../jobs.js";
import { NAME } from "../scan_files.js";
import { packed } from "../scan_zip.js";
import { forget, upload } from "../tus.js";
import { bytes, some } from "../words.js";
import { ask } from "./dialog.js";
import { picture } from "./files.js";
import { findingList, judgedLines, toMend } from "./findings.js";
import { meter } from "./meter.js";
import { state, verdictWords } from "./state.js";
import { sentence } from "./trouble.js";

/**
 * A row; `stage` is ready, waiting, sending, sent, checking, over or failed. `roles` are those of the
 * service's limits.
 */
export class ScanRow {
  constructor({ file, name, role, landmarks, images }, roles, { dropped, again }) {
    this.roles = new Map(roles.map((each) => [each.role, each]));
    this.again = again;
    this.file = file;
    this.landmarks = landmarks;
    this.images = images;
    this.dropped = dropped;
    this.stage = "ready";
    this.replaces = null; // the earlier scan that goes when this one is there
    const beside = [
      landmarks && `landmarks ${landmarks.name}`,
      images.length && `with ${some(images.map((image) => image.name))}`,
    ].filter(Boolean);
    this.name = h("input", {
      type: "text",
      value: name,
      required: true,
      pattern: NAME,
      "aria-label": `Name of ${file.name}`,
      title: "letters, digits, '_', '.' and '-', with a letter or digit first",
      autocomplete: "off",
      spellcheck: "false",
    });
    this.role = h(
      "select",
      { "aria-label": `Role of ${file.name}`, onchange: () => this.mark() },
      roles.map(({ role: value, title }) => h("option", { value }, title)),
    );
    this.role.value = role;
    this.badge = state("queued", "Ready");
    this.how = h("div", { class: "stack" });
    this.actions = h("div", { class: "row end" });
    this.element = h(
      "tr",
      { "data-file": file.name },
      h(
        "th",
        { scope: "row" },
        h("div", {}, file.name),
        h("div", { class: "fine" }, bytes(file.size), beside.map((words) => `, ${words}`)),
      ),
      h("td", {}, this.name),
      h("td", {}, this.role),
      h("td", { class: "tight" }, this.badge),
      h("td", {}, this.how),
      h("td", { class: "tight" }, this.actions),
    );
    this.mark();
    this.ready();
  }

  /** Show at a glance which one is the neutral. */
  mark() {
    this.element.dataset.role = this.role.value;
  }

  ready() {
    const earlier = interrupted.find(this.file);
    show(this.how, earlier && h("p", { class: "fine" }, "Goes on where it stopped."));
    this.offer(["Leave out", () => this.dropped(this)]);
  }

  offer(...buttons) {
    show(
      this.actions,
      buttons.map(([words, action]) =>
        h(
          "button",
          { type: "button", onclick: action },
          words,
          h("span", { class: "unseen" }, ` ${this.file.name}`),
        ),
      ),
    );
  }

  /** Wait to be sent, as a scan of a subject. */
  wait(order) {
    this.order = order;
    this.ending = new AbortController();
    this.stage = "waiting";
    this.badge.set("queued", "Waiting");
    this.name.disabled = this.role.disabled = true;
    show(this.how);
    this.offer(["Leave out", () => this.stop()]);
  }

  /** Send the file and its landmarks. */
  async send() {
    this.stage = "sending";
    this.badge.set("running", "Uploading");
    this.offer(["Stop", () => this.stop()]);
    try {
      this.sent = this.order.registered ? this.file : await packed(this.file, this.images);
      this.uploadId = await this.sendOne(this.sent);
      if (this.landmarks) this.landmarksId = await this.sendOne(this.landmarks);
      this.stage = "sent";
      this.badge.set("queued", "Uploaded");
      show(this.how, h("p", { class: "fine" }, "Its check begins when all files are there."));
      this.offer(["Leave out", () => this.stop()]);
    } catch (error) {
      this.fail(error);
    }
  }

  /** Whether it is to be checked and registered. */
  get isScan() {
    return this.roles.get(this.role.value).is_scan;
  }

  /** What the API is told of the scan once its file is there. */
  get capture() {
    const role = this.role.value;
    return {
      name: this.name.value,
      role,
      upload_id: this.uploadId,
      registered: this.order.registered || !this.isScan,
      landmarks_upload_id: this.landmarksId ?? null,
      replaces: this.replaces,
    };
  }

  sendOne(file) {
    const bar = h("progress", { max: file.size, value: 0, "aria-label": `Upload of ${file.name}` });
    const words = h("p", { class: "fine" });
    show(this.how, bar, words);
    return upload(file, {
      known: interrupted.find(file)?.uploadId,
      started: (id) => interrupted.remember(file, id, this.order.subjectId),
      progress: (arrived) => {
        bar.value = arrived;
        this.arrived = `${bytes(arrived)} of ${bytes(file.size)}`;
        setText(words, this.arrived);
      },
      waiting: (problem) =>
        setText(words, problem ? `${sentence(problem)} Trying again.` : (this.arrived ?? "")),
      signal: this.ending.signal,
    });
  }

  /** Be a scan of the subject: `check` is the job that judges it, null for what is no scan. */
  take({ check }) {
    for (const file of [this.sent, this.landmarks].filter(Boolean)) interrupted.forget(file);
    if (check) {
      this.stage = "checking";
      this.jobId = check.job_id;
      this.badge.set("queued", "Check queued");
      show(this.how);
      show(this.actions, h("a", { class: "button", href: `/jobs/${this.jobId}` }, "Details"));
    } else {
      const { noun, then } = this.roles.get(this.role.value);
      const words = `${noun}: ${then}.`;
      this.finish("succeeded", "Uploaded", h("p", { class: "fine" }, words[0].toUpperCase() + words.slice(1)));
    }
  }

  /** Take what the service says about the scan's check; one that is over is asked for whole. */
  async hear(job) {
    if (job.state === "queued") {
      this.badge.set("queued", "Check queued");
      show(this.how, h("p", { class: "fine" }, inLine(job)));
    } else if (job.state === "running" || job.state === "canceling") {
      this.badge.set("running", "Checking");
      if (!this.bar?.isConnected) show(this.how, (this.bar = meter(job)));
      this.bar.set(job);
    } else if (job.state === "succeeded") {
      this.judge(await get(`/v1/jobs/${job.id}`, {}, this.ending.signal));
    } else {
      const why = job.error?.message ?? "The check was canceled.";
      this.finish(job.state, `Check ${job.state}`, h("p", {}, why));
    }
    if (this.stage === "checking")
      show(this.actions, h("a", { class: "button", href: `/jobs/${job.id}` }, "Details"));
  }

  judge(job) {
    const { summary, artifacts } = job.result;
    const image = artifacts.find(({ name }) => name === "check.png");
    this.finish(
      summary.verdict,
      verdictWords(summary.verdict, job.kind),
      h(
        "div",
        { class: "judged" },
        h("div", { class: "grow" }, findingList(toMend(summary)), judgedLines(summary)),
        image &&
          h(
            "a",
            { href: `/jobs/${job.id}` },
            picture(image, `Check of ${this.name.value}`, this.ending.signal),
          ),
      ),
    );
    announce(`${this.name.value}: ${verdictWords(summary.verdict, job.kind)}`);
  }

  finish(key, words, ...content) {
    this.stage = "over";
    this.badge.set(key, words);
    show(this.how, content);
    show(this.actions, this.jobId && h("a", { class: "button", href: `/jobs/${this.jobId}` }, "Details"));
  }

  /** Say why the scan was not taken, and what can be done. */
  fail(error) {
    if (this.ending.signal.aborted) return;
    if (!(error instanceof ApiProblem)) console.error(error);
    this.stage = "failed";
    this.name.disabled = this.role.disabled = false;
    this.badge.set("failed", "Refused");
    show(this.how, h("p", {}, sentence(error)));
    announce(`${this.file.name}: ${sentence(error)}`);
    if (error.code === "capture.unknown") this.replaces = null; // somebody else has deleted it
    const inTheWay = error.document?.capture_id;
    const replaces = ["capture.name_taken", "capture.neutral_exists"].includes(error.code) && inTheWay;
    this.offer(
      ...(replaces ? [["Replace the earlier scan", () => this.replace(inTheWay)]] : []),
      ["Try again", () => this.again(this)],
      ["Leave out", () => this.stop()],
    );
  }

  /** Have the service delete the earlier scan in the step that adds this one. */
  async replace(captureId) {
    const agreed = await ask({
      title: "Replace the earlier scan?",
      body: h(
        "p",
        {},
        "When this one is there, the earlier scan goes with its checks and registrations. Models and rigs made from it stay.",
      ),
      agree: "Replace it",
      danger: true,
      act: async () => true,
    });
    if (!agreed) return;
    this.replaces = captureId;
    this.again(this);
  }

  /** Leave the file out; what has arrived of it is given up. */
  stop() {
    this.ending?.abort();
    const sent = this.sent ?? this.file;
    const earlier = interrupted.find(sent);
    if (earlier) forget(earlier.uploadId).catch(() => {}); // it expires by itself
    interrupted.forget(sent);
    this.dropped(this);
  }
}
