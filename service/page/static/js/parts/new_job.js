// Asking for a job: its kind is given, its options and its priority can be chosen.

import { h } from "../dom.js";
import { retry, submit } from "../jobs.js";
import { kindsByName } from "../library.js";
import { ask } from "./dialog.js";
import { handedOnFields, MARKER_SET } from "./handed_on.js";
import { optionFields, readOptions } from "./options.js";
import { addNeckField } from "./scene_neck.js";

/**
 * Show a job's options and submit it; resolves to the new job, or null.
 *
 * `request` is what the API takes: kind, subject_id, captures, rig_id, from_jobs; `options` are
 * filled in. `marker_set`, the id of one that was uploaded, is read unless one of a job is chosen.
 */
export async function askForJob({ marker_set: set = null, options = {}, ...request }) {
  const kind = (await kindsByName()).get(request.kind);
  const priority = priorityField(0);
  const handed = await handedOnFields(kind, request);
  const fields = optionFields(kind.options, options);
  const neck = await addNeckField(kind, fields, request);
  return ask({
    title: kind.title,
    body: [h("p", {}, kind.description), handed.element, fields, priority],
    agree: "Submit",
    act: (form) => {
      const left = handed.read();
      const read = new Set([...(request.captures ?? []), ...neck.read()]);
      const hasSet = left.some(({ artifact }) => artifact === MARKER_SET);
      const captures = [...read, ...(set && !hasSet ? [set] : [])];
      const more = { captures, from_jobs: left, options: readOptions(kind.options, form) };
      return submit({ ...request, ...more, priority: valueOf(priority) });
    },
  });
}

/** Show the options of a job that is over and make it again; resolves to the new job, or null. */
export async function askToRunAgain(job) {
  const kind = (await kindsByName()).get(job.kind);
  const priority = priorityField(job.priority);
  const fields = optionFields(kind.options, job.options);
  await addNeckField(kind, fields, job, true);
  const note = "It reads the same scans and files, as they are now; nothing is uploaded again. The first job stays.";
  return ask({
    title: `${kind.title}: run again`,
    body: [
      h("p", {}, kind.description),
      h("p", { class: "fine" }, note),
      fields,
      priority,
    ],
    agree: "Run again",
    act: (form) =>
      retry(job.id, {
        options: readOptions(kind.options, form, job.options),
        priority: valueOf(priority),
      }),
  });
}

function priorityField(value) {
  return h(
    "label",
    { class: "field" },
    h("span", {}, "Priority"),
    h("input", { type: "number", min: -9, max: 9, step: 1, required: true, value }),
    h("span", { class: "fine" }, "9: before this studio's other jobs, -9: after them"),
  );
}

function valueOf(field) {
  return Number(field.querySelector("input").value);
}
