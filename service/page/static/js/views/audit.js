// The audit log: what was done with the studio's keys, newest first; for keys that may `admin`.

import { all } from "../api.js";
import { h } from "../dom.js";
import { Paged } from "../parts/paged.js";
import { doing } from "../parts/toast.js";
import { replaceQuery } from "../navigate.js";
import { plain, when } from "../words.js";

export async function mount(root, _params, query) {
  const ending = new AbortController();
  const { signal } = ending;
  const keys = new Map((await all("/v1/keys", {}, signal)).map(({ id, name }) => [id, name]));
  const list = new Paged({
    path: "/v1/audit",
    label: "Actions",
    columns: ["When", "Action", "About", "Key", "Request"],
    row: (entry) => row(entry, keys),
    empty: "Nothing was done that is like that.",
    signal,
  });
  const about = h("input", {
    type: "search",
    value: query.get("object_id") ?? "",
    maxlength: 36,
    pattern: "[0-9A-Za-z\\-]*",
    title: "an id: letters, digits and '-'",
    placeholder: "All",
    autocomplete: "off",
    spellcheck: "false",
  });
  const find = h("button", {}, "Find");
  const search = () => {
    const id = about.value.trim();
    replaceQuery(new URLSearchParams(id ? { object_id: id } : {}));
    return list.first({ object_id: id });
  };
  const form = h(
    "form",
    {
      class: "row",
      role: "search",
      onsubmit: (event) => {
        event.preventDefault();
        doing(find, search);
      },
    },
    h("label", { class: "row" }, "Only about the id", about),
    find,
  );
  root.append(h("div", { class: "head" }, h("h1", { class: "grow" }, "Audit log"), form), ...list.elements);
  await search();
  return () => ending.abort();
}

function row({ created_at: at, action, object_id: about, key_id: key, request_id: request }, keys) {
  return h(
    "tr",
    {},
    h("td", { class: "tight" }, when(at)),
    h("th", { scope: "row" }, plain(action.replace(".", " "))),
    h("td", { class: "breaks" }, h("a", { href: `/audit?object_id=${about}` }, h("code", {}, about))),
    h("td", { class: "breaks" }, keys.get(key) ?? h("code", {}, key)),
    h("td", { class: "breaks" }, h("code", {}, request)),
  );
}
