// Questions that need an answer.

import { h } from "../dom.js";
import { sentence } from "./trouble.js";

/**
 * Ask, with `body` between title and buttons. `act(form)` is called when the person agrees; the
 * dialog closes when it is done and shows why it was not. Resolves to what `act` returned; null:
 * the person thought better of it.
 */
export function ask({ title, body, agree, act, danger = false }) {
  return new Promise((resolve) => {
    const fault = h("div", { class: "notice bad", role: "alert", hidden: true });
    const yes = h("button", { class: danger ? "main danger" : "main" }, agree);
    const no = h("button", { type: "button", onclick: () => dialog.close() }, "Back");
    const form = h(
      "form",
      { onsubmit: submit },
      h("h2", { id: "dialog-title" }, title),
      body,
      fault,
      h("div", { class: "row end" }, no, yes),
    );
    const dialog = h("dialog", { "aria-labelledby": "dialog-title", onclose: end }, form);
    let answer = null;
    dialog.addEventListener("cancel", (event) => yes.disabled && event.preventDefault()); // it is being done
    document.body.append(dialog);
    dialog.showModal();

    async function submit(event) {
      event.preventDefault();
      yes.disabled = no.disabled = true;
      try {
        answer = await act(form);
        dialog.close();
      } catch (error) {
        if (error.name !== "ApiProblem") console.error(error);
        fault.textContent = sentence(error);
        fault.hidden = false;
        yes.disabled = no.disabled = false;
      }
    }

    function end() {
      dialog.remove();
      resolve(answer);
    }
  });
}
