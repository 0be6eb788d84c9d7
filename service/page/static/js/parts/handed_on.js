// What earlier jobs of a person left, to be chosen as inputs of another.

import { get } from "../api.js";
import { h } from "../dom.js";
import { kindsByName } from "../library.js";
import { plain, when } from "../words.js";

/** The file in which a check of markers leaves their places. */
export const MARKER_SET = "markers.json";
// Jobs that are offered with a file of a name, the newest
const MOST = 5;
// Inputs that are chosen here; others a job finds by itself
const CHOSEN = ["markers", "sequences", "signals"];
// Those that a scene names
const NAMED = ["sequences", "signals"];

/**
 * Return the fields in which files of earlier jobs are chosen for a job of `kind`, and what reads
 * them: `{element, read()}`. `request` is what is asked for; what its `from_jobs` names is chosen,
 * and is read as well where it is not offered.
 */
export async function handedOnFields(kind, request) {
  const given = request.from_jobs ?? [];
  const files = await offered(kind, request);
  const others = given.filter((each) => !files.some((file) => isSame(each, file)));
  const rows = files.map((file) => row(file, given));
  const element = rows.length
    ? h("fieldset", { class: "options" }, h("legend", {}, "What earlier jobs left"), rows.map((each) => each.element))
    : null;
  return { element, read: () => [...rows.map((each) => each.read()).filter(Boolean), ...others] };
}

/** Return the files that a kind of job reads: `{job, artifact, input, words}`. */
async function offered(kind, request) {
  const wanted = CHOSEN.filter((input) => kind.reads.includes(input));
  const handed = [...(await kindsByName()).values()].flatMap((each) => Object.entries(each.hands_on));
  const files = new Map(handed.filter(([, input]) => wanted.includes(input)));
  return (await Promise.all([...files].map((file) => filesCalled(file, request.subject_id)))).flat();
}

/** Return the newest files of a name that jobs of a person left: one request. */
async function filesCalled([artifact, input], subjectId) {
  const { items } = await get("/v1/jobs", { subject_id: subjectId, has: artifact, limit: MOST });
  return items.map(({ id, kind, finished_at: at }) => ({
    job: id,
    artifact,
    input,
    words: `${artifact} of ${plain(kind)}, ${when(at)}`,
  }));
}

function row({ job, artifact, input, words }, given) {
  const known = given.find((each) => isSame(each, { job, artifact }));
  const box = h("input", { type: "checkbox", checked: Boolean(known) });
  const usual = artifact.replace(/\.[^.]*$/, "");
  const name =
    NAMED.includes(input) &&
    h("input", { type: "text", value: known?.name ?? usual, "aria-label": `What a scene calls ${words}` });
  const field = name && h("div", {}, h("span", { class: "fine" }, "What the scene calls it"), name);
  return {
    element: h("div", { class: "field" }, h("label", { class: "check-field" }, box, words), field || null),
    read: () => box.checked && { job, artifact, ...(name && name.value !== usual ? { name: name.value } : {}) },
  };
}

function isSame(one, other) {
  return one.job === other.job && one.artifact === other.artifact;
}
