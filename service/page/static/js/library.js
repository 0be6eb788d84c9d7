// A cache of what changes rarely and many views need: names of subjects and scans, the kinds of job.

import { all, get } from "./api.js";
import * as auth from "./auth.js";
import { short, when } from "./words.js";

let subjects = null; // id -> subject, as a promise
const captures = new Map(); // subject's id -> promise of id -> capture
let kinds = null;
let limits = null;
let me = null;

/** Return the subjects as a Map by id; asked anew if `wanted` is not among those known. */
export async function subjectsById(wanted = null) {
  if (!subjects || (wanted && !(await subjects).has(wanted))) {
    subjects = byId(all("/v1/subjects"));
    subjects.catch(() => (subjects = null));
  }
  return subjects;
}

/** Return a subject's name, so that nobody is taken for another; its id while there is none. */
export async function subjectName(id) {
  return names(await subjectsById(id)).get(id) ?? id;
}

/** Return the names of subjects by id; who shares a name also has the beginning of the id and a day. */
export function names(found) {
  const bearers = new Map();
  for (const { name } of found.values()) bearers.set(name, (bearers.get(name) ?? 0) + 1);
  return new Map(
    [...found.values()].map(({ id, name, created_at: added }) => [
      id,
      bearers.get(name) === 1 ? name : `${name} (${short(id)}, ${when(added)})`,
    ]),
  );
}

/** Return a subject's captures as a Map by id; asked anew if one of `wanted` is not known. */
export async function capturesById(subjectId, wanted = []) {
  const known = captures.get(subjectId);
  if (known && !wanted.length) return known;
  if (known) {
    const found = await known;
    if (wanted.every((id) => found.has(id))) return found;
  }
  const asked = byId(all(`/v1/subjects/${subjectId}/captures`));
  captures.set(subjectId, asked);
  asked.catch(() => captures.delete(subjectId));
  return asked;
}

/** Forget names: something was added or deleted. */
export function changed(subjectId = null) {
  subjects = null;
  if (subjectId) captures.delete(subjectId);
}

document.addEventListener("keychange", () => {
  // another key may be another studio's
  subjects = kinds = limits = me = null;
  captures.clear();
});

/** Return the kinds of job as a Map by their key. */
export async function kindsByName() {
  kinds ??= get("/v1/kinds").then(({ items }) => new Map(items.map((kind) => [kind.kind, kind])));
  kinds.catch(() => (kinds = null));
  return kinds;
}

/** Return what the service accepts. */
export async function serviceLimits() {
  limits ??= get("/v1/limits");
  limits.catch(() => (limits = null));
  return limits;
}

/** Return the roles of captures as a Map by their names. */
export async function rolesByName() {
  return new Map((await serviceLimits()).roles.map((each) => [each.role, each]));
}

/** Return whose key this tab has (`/v1/me`); null without one. */
export async function myself() {
  if (!auth.key()) return null;
  me ??= get("/v1/me");
  me.catch(() => (me = null));
  return me;
}

async function byId(list) {
  return new Map((await list).map((item) => [item.id, item]));
}

/** Say which scans a job is about: their names if they are few. */
export async function scansOf(job, most = 2) {
  if (!job.captures.length) return "";
  if (job.captures.length > most) return `${job.captures.length} scans`;
  const found = await capturesById(job.subject_id, job.captures);
  return job.captures.map((id) => found.get(id)?.name ?? "a deleted scan").join(", ");
}
