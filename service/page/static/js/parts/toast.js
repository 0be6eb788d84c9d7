// Passing words in a corner: what was done, or why not.

import { h } from "../dom.js";
import { sentence } from "./trouble.js";

const SECONDS = 8;

/** Show a sentence for a while; `tone` is `good` or `bad`. */
export function toast(text, tone = "good") {
  const toasts = document.getElementById("toasts");
  for (const other of [...toasts.children]) if (other.dataset.text === text) other.remove(); // said once is enough
  const box = h(
    "div",
    { class: `notice ${tone}`, "data-text": text, role: tone === "bad" ? "alert" : "status" },
    h(
      "div",
      { class: "row" },
      h("p", { class: "grow" }, text),
      h(
        "button",
        { type: "button", class: "plain", "aria-label": "Close", onclick: () => box.remove() },
        "✕",
      ),
    ),
  );
  toasts.append(box);
  if (tone !== "bad") setTimeout(() => box.remove(), 1000 * SECONDS);
}

/** Run what a button does; while it runs the button is off, and an error is told. */
export async function doing(button, action) {
  button.disabled = true;
  try {
    return await action();
  } catch (error) {
    if (error.name !== "ApiProblem") console.error(error);
    toast(sentence(error), "bad");
    return null;
  } finally {
    button.disabled = false;
  }
}
