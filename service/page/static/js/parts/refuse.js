// Buttons that are off say why: to the pointer by a title, to a screen reader by a description.

import { h, setText } from "../dom.js";

const words = new WeakMap();
let made = 0;

/** Switch a button of the page off and give the reason; without one, switch it on. */
export function refuse(button, why) {
  button.disabled = Boolean(why);
  if (!words.has(button)) words.set(button, h("span", { class: "unseen", id: `why-off-${made++}` }));
  const reason = words.get(button);
  setText(reason, why ?? "");
  if (why) {
    button.title = why;
    button.setAttribute("aria-describedby", reason.id);
    if (!reason.isConnected) button.after(reason);
  } else {
    button.removeAttribute("title");
    button.removeAttribute("aria-describedby");
    reason.remove();
  }
}
