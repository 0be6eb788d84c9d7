// Helpers for the views that show jobs.

import { post, put, serverNow } from "./api.js";
import { count } from "./words.js";

let unanswered = { body: null, id: null };

/** Submit a job under an id of our own: sent again after an answer that was lost, it is still one job. */
export async function submit(request, signal = undefined) {
  const body = JSON.stringify(request);
  if (unanswered.body !== body) unanswered = { body, id: newId() };
  const job = await put(`/v1/jobs/${unanswered.id}`, request, signal);
  unanswered = { body: null, id: null };
  return job;
}

/** Make a job that is over again, with options that differ from its own. */
export async function retry(jobId, changes) {
  return post(`/v1/jobs/${jobId}/retry`, changes);
}

/** Ask for a job to stop. */
export async function cancel(jobId, reason) {
  return post(`/v1/jobs/${jobId}/cancel`, { reason, by: "page" });
}

/** Return a job with what an event says; the rest (attempts, result) is asked of the API. */
export function applied(job, { id, event, data }) {
  const { attempt, ...rest } = data;
  const known = { ...job, attempt, last_event_id: id };
  if (event === "progress") return { ...known, progress: rest, phase: rest.phase };
  if (event !== "state") return known;
  const progress = rest.state === job.state ? job.progress : null;
  return { ...known, progress, state: rest.state, error: rest.error ?? null };
}

/** Return a queued job's place in words. */
export function inLine({ queue_position: position }) {
  if (position === null) return "Put off: it is tried again in a while";
  return position === 1 ? "Next in line" : `${count(position - 1, "job")} before it`;
}

/** Return for how many seconds a job ran or has been running; null before it started. */
export function seconds({ started_at: started, finished_at: finished }) {
  if (!started) return null;
  return ((finished ? Date.parse(finished) : serverNow()) - Date.parse(started)) / 1000;
}

/** Return a random UUID; `crypto.randomUUID` is only there over https and on this machine. */
export function newId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
  return hex.replace(/^(.{8})(.{4})(.{4})(.{4})(.{12})$/, "$1-$2-$3-$4-$5");
}
