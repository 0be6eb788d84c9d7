// Jobs that read files of a scan or of another job: what was made of them stays when they go.

import { get } from "../api.js";
import { h, joined } from "../dom.js";
import { plain, when } from "../words.js";

// Jobs that are named, the newest
const MOST = 5;
// Kinds that are about one scan, and go with it
const OF_A_SCAN = ["check_scan", "register_scan"];

/** Return the newest jobs of a person that read a file of the scan or job `id`. */
export async function readersOf(subjectId, id, signal) {
  const query = { subject_id: subjectId, reads: id, limit: MOST };
  return (await get("/v1/jobs", query, signal)).items;
}

/** Return links to jobs, with commas. */
export function jobLinks(jobs) {
  return joined(jobs.map((job) => h("a", { href: `/jobs/${job.id}` }, called(job))));
}

/** Say which jobs read a scan or its registration, and stay when it is deleted; "" if none does. */
export async function toldBeforeDeletion({ id, subject_id: subjectId, registration }) {
  const sources = [id, registration?.job_id].filter(Boolean);
  const found = (await Promise.all(sources.map((each) => readersOf(subjectId, each)))).flat();
  const staying = found.filter(({ kind }) => !OF_A_SCAN.includes(kind));
  if (!staying.length) return "";
  return `Jobs that have read it stay, but cannot be run again as they were: ${staying.map(called).join("; ")}.`;
}

function called({ kind, created_at: at }) {
  return `${plain(kind)}, ${when(at)}`;
}
