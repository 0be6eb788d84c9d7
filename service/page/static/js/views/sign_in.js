// The API key: typed in, kept as long as the tab lives, forgotten on request.

import { get } from "../api.js";
import * as auth from "../auth.js";
import { h, show } from "../dom.js";
import { sentence } from "../parts/trouble.js";
import { navigate } from "../router.js";

const WHY = {
  "auth.missing": "This service asks for a key.",
  "auth.invalid": "The key is not one of this service's, or was revoked.",
  "auth.expired": "The key has expired. Ask for a new one.",
};

export async function mount(root, _params, query) {
  const next = inside(query.get("next"));
  const why = WHY[query.get("why")];
  const fault = h("div", { class: "notice bad", role: "alert", hidden: !why }, h("p", {}, why ?? ""));
  const key = h("input", { type: "password", id: "key", required: true, autocomplete: "off", spellcheck: "false" });
  const enter = h("button", { class: "main" }, "Sign in");
  const form = h("form", { class: "panel stack narrow", onsubmit: submit },
    h("div", { class: "field" }, h("label", { for: "key" }, "API key"), key,
      h("span", { class: "fine" }, "It stays in this tab and is forgotten when the tab is closed.")),
    h("div", { class: "row" }, enter));
  const account = h("div", { class: "panel stack narrow", hidden: !auth.key() },
    h("p", {}, "This tab has a key."),
    h("div", { class: "row" }, h("button", { type: "button", onclick: leave }, "Sign out")));
  show(root, h("h1", {}, "Key"), fault, account, form);
  key.focus();

  async function submit(event) {
    event.preventDefault();
    const before = auth.key();
    enter.disabled = true;
    auth.keep(key.value);
    try {
      await get("/v1/jobs", { limit: 1 });
      navigate(next, { replace: true });
    } catch (error) {
      if (before) auth.keep(before);
      else auth.forget();
      show(fault, h("p", {}, WHY[error.code] ?? sentence(error)));
      fault.hidden = false;
      enter.disabled = false;
    }
  }

  function leave() {
    auth.forget();
    account.hidden = true;
    key.focus();
  }
}

/** Return a path of this page; an address that came from elsewhere must not lead away. */
function inside(path) {
  return path?.startsWith("/") && !path.startsWith("//") && !path.startsWith("/\\") ? path : "/";
}
