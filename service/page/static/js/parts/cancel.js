// The button that stops a job.

import { h } from "../dom.js";
import { cancel } from "../jobs.js";
import { ask } from "./dialog.js";

/** Ask for a reason and stop a job; resolves to the job as it is then, or null. */
export function askToCancel(jobId, title) {
  const reason = h("input", { type: "text", name: "reason", maxlength: 200, autocomplete: "off" });
  return ask({
    title: `Cancel ${title}?`,
    body: [
      h("p", {}, "What it has done so far is thrown away. It can be run again later."),
      h(
        "label",
        { class: "field" },
        h("span", {}, "Reason"),
        reason,
        h("span", { class: "fine" }, "Kept with the job, so that others know why."),
      ),
    ],
    agree: "Cancel the job",
    danger: true,
    act: () => cancel(jobId, reason.value.trim()),
  });
}
