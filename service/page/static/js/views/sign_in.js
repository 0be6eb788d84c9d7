// The API key: typed in, kept as long as the tab lives, forgotten on request; and, for who may see
// them, all keys of the studio.

import { get } from "../api.js";
import * as auth from "../auth.js";
import { h, show } from "../dom.js";
import { keyPanel } from "../parts/keys.js";
import { sentence } from "../parts/trouble.js";
import { navigate } from "../navigate.js";

const WHY = {
  "auth.missing": "This service asks for a key.",
  "auth.invalid": "The key is not one of this service's, or was revoked.",
  "auth.expired": "The key has expired. Ask for a new one.",
};

export async function mount(root, _params, query) {
  const ending = new AbortController();
  if (auth.key() && !query.get("why")) await showAccount(root, ending.signal);
  else showForm(root, inside(query.get("next")), WHY[query.get("why")]);
  return () => ending.abort();
}

async function showAccount(root, signal) {
  const me = await get("/v1/me", {}, signal);
  root.append(
    h(
      "div",
      { class: "head" },
      h("h1", { class: "grow" }, "Key"),
      h("button", { type: "button", onclick: leave }, "Sign out"),
    ),
    h(
      "section",
      { class: "panel", "aria-label": "This key" },
      h(
        "dl",
        { class: "facts" },
        h("dt", {}, "Studio"),
        h("dd", {}, me.tenant),
        h("dt", {}, "Key"),
        h("dd", {}, h("code", {}, me.key_id)),
        h("dt", {}, "It may"),
        h("dd", {}, me.scopes.join(", ")),
      ),
    ),
  );
  if (me.scopes.includes("admin")) root.append(await keyPanel(me.key_id, signal));
}

function leave() {
  auth.forget();
  navigate("/sign-in");
}

function showForm(root, next, why) {
  const fault = h("div", { class: "notice bad", role: "alert", hidden: !why }, h("p", {}, why ?? ""));
  const key = h("input", {
    type: "password",
    id: "key",
    required: true,
    autocomplete: "off",
    spellcheck: "false",
  });
  const enter = h("button", { class: "main" }, "Sign in");
  const form = h(
    "form",
    { class: "panel stack narrow", onsubmit: submit },
    h(
      "div",
      { class: "field" },
      h("label", { for: "key" }, "API key"),
      key,
      h(
        "span",
        { class: "fine" },
        "It stays in this tab and is forgotten when the tab is closed. " +
          "The service's first start leaves one in the file admin.key in its data folder.",
      ),
    ),
    h("div", { class: "row" }, enter),
  );
  show(root, h("h1", {}, "Sign in"), fault, form);
  key.focus();

  async function submit(event) {
    event.preventDefault();
    enter.disabled = true;
    auth.keep(key.value);
    try {
      await get("/v1/me");
      navigate(next, { replace: true });
    } catch (error) {
      auth.forget();
      show(fault, h("p", {}, WHY[error.code] ?? sentence(error)));
      fault.hidden = false;
      enter.disabled = false;
    }
  }
}

/** Return a path of this page; an address that came from elsewhere must not lead away. */
function inside(path) {
  return path?.startsWith("/") && !path.startsWith("//") && !path.startsWith("/\\") ? path : "/";
}
