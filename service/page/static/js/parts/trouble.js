// An error in the service's own sentence, and a way on.

import { h } from "../dom.js";

const UNKNOWN =
  "The page failed to show this. Reload it; if that does not help, tell whoever runs the service.";

/** Return the sentence of an error. */
export function sentence(error) {
  const text = error.name === "ApiProblem" ? error.message : UNKNOWN;
  return text.charAt(0).toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
}

/** Return an element that tells an error; `again` is called by its button. */
export function trouble(error, again) {
  if (error.name !== "ApiProblem") console.error(error);
  const requestId = error.document?.request_id;
  return h(
    "div",
    { class: "notice bad", role: "alert" },
    h("h1", {}, error.status === 404 ? "Not there" : "That did not work"),
    h("p", {}, sentence(error)),
    requestId && h("p", { class: "fine" }, `${error.code}, request ${requestId}`),
    again && h("button", { type: "button", onclick: again }, "Try again"),
  );
}
