// Deleting a person: named once more, since nothing brings it back.

import { remove } from "../api.js";
import { h } from "../dom.js";
import { ask } from "./dialog.js";

/** Ask and delete; resolves to true if it was done. */
export function askToDeleteSubject(subject) {
  const compare = () => typed.setCustomValidity(alike(typed.value) === alike(subject.name) ? "" : `Type ${subject.name}`);
  const typed = h("input", { type: "text", required: true, autocomplete: "off", oninput: compare });
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
        typed,
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

/** Return a name as it is seen: blanks in a row look like one. */
function alike(name) {
  return name.trim().replace(/\s+/g, " ");
}
