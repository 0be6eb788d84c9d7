// Webhooks: which addresses are told what happens; for keys that may `webhooks`.

import { h, show } from "../dom.js";
import { kindsByName } from "../library.js";
import { Paged } from "../parts/paged.js";
import { doing } from "../parts/toast.js";
import { askForWebhook, standing, toldOf } from "../parts/webhook.js";
import { when } from "../words.js";

export async function mount(root) {
  const ending = new AbortController();
  const kinds = await kindsByName();
  const list = new Paged({
    path: "/v1/webhooks",
    label: "Webhooks",
    columns: ["Address", "Is told of", "State", "Added"],
    row: (webhook) => row(webhook, kinds),
    empty: "Nobody is told. Add an address, and the service sends what happens to it.",
    signal: ending.signal,
  });
  const add = h(
    "button",
    { type: "button", onclick: () => doing(add, async () => (await askForWebhook(kinds)) && list.first()) },
    "Add a webhook",
  );
  show(root, h("div", { class: "head" }, h("h1", { class: "grow" }, "Webhooks"), add), list.elements);
  await list.refresh();
  return () => ending.abort();
}

function row(webhook, kinds) {
  return h(
    "tr",
    {},
    h("th", { scope: "row", class: "breaks" }, h("a", { href: `/webhooks/${webhook.id}` }, webhook.url)),
    h("td", {}, toldOf(webhook, kinds)),
    h("td", { class: "tight" }, standing(webhook)),
    h("td", { class: "tight" }, when(webhook.created_at)),
  );
}
