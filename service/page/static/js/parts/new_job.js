// Asking for a job: its kind is given, its options can be chosen.

import { h } from "../dom.js";
import { submit } from "../jobs.js";
import { kindsByName } from "../library.js";
import { ask } from "./dialog.js";
import { optionFields, readOptions } from "./options.js";

/**
 * Show a job's options and submit it; resolves to the new job, or null.
 *
 * `request` is what the API takes: kind, subject_id, captures, rig_id, options.
 */
export async function askForJob(request, { title, note = null, agree = "Submit" } = {}) {
  const kind = (await kindsByName()).get(request.kind);
  return ask({
    title: title ?? kind.title,
    body: [
      h("p", {}, kind.description),
      note && h("p", { class: "fine" }, note),
      optionFields(kind.options, request.options),
    ],
    agree,
    act: (form) => submit({ ...request, options: readOptions(kind.options, form) }),
  });
}
