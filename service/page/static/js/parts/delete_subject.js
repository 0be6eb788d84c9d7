// Deleting a person: named once more, since nothing brings it back.

import { remove } from "../api.js";
import { h } from "../dom.js";
import { ask } from "./dialog.js";

/** Ask and delete; resolves to true if it was done. */
export function askToDeleteSubject(subject) {
  const pattern = subject.name.replace(/[-/\\^$*+?.()|[\]{}]/g, "\\$&");
  return ask({
    title: `Delete ${subject.name}?`,
    body: [
      h(
        "p",
        {},
        "All of this person's scans, jobs, rigs and files are removed, for good. Jobs that run are stopped first.",
      ),
      h(
        "label",
        { class: "field" },
        h("span", {}, `To be sure, type the name: ${subject.name}`),
        h("input", { type: "text", required: true, pattern, autocomplete: "off", title: subject.name }),
      ),
    ],
    agree: "Delete for good",
    danger: true,
    act: async () => {
      await remove(`/v1/subjects/${subject.id}?cancel=true`);
      return true;
    },
  });
}
