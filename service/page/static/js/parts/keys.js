// The studio's API keys, for a key with the scope `admin`: make, replace, revoke.

import { all, post, remove } from "../api.js";
import { h, show } from "../dom.js";
import { when } from "../words.js";
import { ask } from "./dialog.js";
import { table } from "./frame.js";
import { state } from "./state.js";
import { doing, toast } from "./toast.js";

const SCOPES = {
  read: "see everything",
  write: "upload scans, submit and cancel jobs",
  delete: "delete scans and subjects",
  webhooks: "say who is told what happens",
  metrics: "read metrics and the workers' names",
  admin: "make and revoke keys, read the audit log",
};
const FOR_A_STATION = new Set(["read", "write"]);

/** Return a panel of all keys; `mine` is the id of the one in use. */
export async function keyPanel(mine, signal) {
  const body = h("tbody");
  const refresh = async () => {
    const keys = await all("/v1/keys", {}, signal);
    show(
      body,
      keys.map((key) => row(key, mine, refresh)),
    );
  };
  const make = h(
    "button",
    { type: "button", onclick: () => doing(make, async () => (await askForKey()) && refresh()) },
    "Make a key",
  );
  await refresh();
  return h(
    "section",
    { class: "panel", "aria-labelledby": "keys" },
    h("div", { class: "head" }, h("h2", { id: "keys", class: "grow" }, "Keys of this studio"), make),
    table(["Name", "May", "State", "Last used", "Ends", "(Actions)"], body),
  );
}

function row(key, mine, refresh) {
  const hasEnded = key.revoked_at || (key.expires_at && Date.parse(key.expires_at) < Date.now());
  const act = (words, kind, action) => {
    const button = h(
      "button",
      {
        type: "button",
        class: kind,
        onclick: () => doing(button, async () => (await action(key)) && refresh()),
      },
      words,
      h("span", { class: "unseen" }, ` ${key.name}`),
    );
    return button;
  };
  return h(
    "tr",
    {},
    h(
      "th",
      { scope: "row" },
      key.name,
      h("div", { class: "fine" }, key.id, key.id === mine ? ", this tab's" : ""),
    ),
    h("td", {}, key.scopes.join(", ")),
    h(
      "td",
      { class: "tight" },
      hasEnded ? state("canceled", key.revoked_at ? "Revoked" : "Expired") : state("ok", "Works"),
    ),
    h("td", { class: "tight" }, key.last_used_at ? when(key.last_used_at) : "never"),
    h("td", { class: "tight" }, key.expires_at ? when(key.expires_at) : "never"),
    h(
      "td",
      { class: "tight" },
      !hasEnded &&
        h("div", { class: "row end" }, act("Replace", null, replace), act("Revoke", "plain danger", revoke)),
    ),
  );
}

async function askForKey() {
  const name = h("input", {
    type: "text",
    required: true,
    maxlength: 200,
    autocomplete: "off",
    placeholder: "capture station 2",
  });
  const ends = h("input", { type: "date", min: new Date().toISOString().slice(0, 10) });
  const boxes = Object.entries(SCOPES).map(([scope, words]) => {
    const box = h("input", { type: "checkbox", value: scope });
    box.checked = FOR_A_STATION.has(scope);
    return h("label", { class: "check-field" }, box, h("span", {}, h("strong", {}, scope), `: ${words}`));
  });
  const made = await ask({
    title: "Make a key",
    body: [
      h("label", { class: "field" }, h("span", {}, "For whom"), name),
      h("fieldset", {}, h("legend", {}, "It may"), boxes),
      h("label", { class: "field" }, h("span", {}, "Ends after (empty: never)"), ends),
    ],
    agree: "Make it",
    act: () =>
      post("/v1/keys", {
        name: name.value,
        scopes: boxes
          .map((label) => label.querySelector("input"))
          .filter(({ checked }) => checked)
          .map(({ value }) => value),
        expires_at: ends.value ? new Date(`${ends.value}T23:59:59`).toISOString() : null,
      }),
  });
  return made && tell(made);
}

async function replace(key) {
  const made = await ask({
    title: `Replace the key ${key.name}?`,
    body: h("p", {}, "A new key of the same scopes is made. The old one works for another day."),
    agree: "Replace",
    act: () => post(`/v1/keys/${key.id}/rotate`),
  });
  return made && tell(made);
}

function revoke(key) {
  return ask({
    title: `Revoke the key ${key.name}?`,
    body: h("p", {}, "It opens nothing any more, at once. Stations that use it stop."),
    agree: "Revoke",
    danger: true,
    act: async () => {
      await remove(`/v1/keys/${key.id}`);
      return true;
    },
  });
}

/** Show a new key's text, the only time that it is told. */
async function tell({ name, key }) {
  const text = h("input", {
    type: "text",
    readonly: true,
    value: key,
    "aria-label": `The key ${name}`,
    class: "mono",
    onfocus: () => text.select(),
  });
  await ask({
    title: `The key ${name}`,
    body: [h("p", {}, "Copy it now: it is not shown again."), text],
    agree: "I have it",
    act: () => true,
  });
  toast(`The key ${name} was made.`);
  return true;
}
