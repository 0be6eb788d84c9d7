// Frames that most views are made of.

import { h } from "../dom.js";

/** Return a titled part of a view. */
export function panel(id, title, ...content) {
  return h("section", { class: "panel", "aria-labelledby": id }, h("h2", { id }, title), content);
}

/** Return a table with its columns' names; one that is not shown is given as `(name)`. */
export function table(names, body, attributes = {}) {
  const heads = names.map((name) => h("th", { scope: "col" }, shown(name)));
  return h("div", { class: "scroll" }, h("table", attributes, h("thead", {}, h("tr", {}, heads)), body));
}

function shown(name) {
  return name.startsWith("(") ? h("span", { class: "unseen" }, name.slice(1, -1)) : name;
}
