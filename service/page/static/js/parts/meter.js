// The progress of a job: its phase, a bar, and about how long it will take.

import { serverNow } from "../api.js";
import { h, setText } from "../dom.js";
import { plain, span } from "../words.js";

const LEAST_FRACTION = 0.1;
const LEAST_SECONDS = 3;

/** Return an element for a job; `meter.set(job)` changes it. */
export function meter(job) {
  const phase = h("span");
  const left = h("span");
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const element = h("div", { class: "meter" }, bar, h("div", { class: "fine" }, phase, left));
  element.set = (next) => {
    bar.value = next.progress?.fraction ?? 0;
    setText(phase, next.progress ? step(next.progress) : "Starting");
    setText(left, remaining(next));
  };
  element.set(job);
  return element;
}

/** Say what a running job does: its phase and, where it tells, its iteration. */
export function step(progress) {
  const iteration = progress.iteration === undefined ? "" : `, iteration ${progress.iteration}`;
  return plain(progress.phase) + iteration;
}

/** Say how long a running job will take, going by how long the part behind it took. */
function remaining(job) {
  const fraction = job.progress?.fraction ?? 0;
  const started = job.attempts.at(-1)?.started_at;
  if (job.state !== "running" || !started) return "";
  const seconds = (serverNow() - Date.parse(started)) / 1000;
  if (fraction < LEAST_FRACTION || seconds < LEAST_SECONDS) return "";
  const left = (seconds * (1 - fraction)) / fraction;
  return left < 1 ? "" : `about ${span(left)} left`;
}
