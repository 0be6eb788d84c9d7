// Parts of the views of webhooks: the form, the state in words, the secret that is shown once.

import { patch, post } from "../api.js";
import { h } from "../dom.js";
import { plain } from "../words.js";
import { ask } from "./dialog.js";
import { state } from "./state.js";

const EVENTS = {
  "job.started": "a job begins",
  "job.succeeded": "a job succeeds",
  "job.failed": "a job fails",
  "job.canceled": "a job is canceled",
  "scan.checked": "a scan has its verdict",
  "batch.finished": "a session is finished",
};

const OFF = {
  gone: "Off: the address said it is gone",
  failing: "Off: it failed for too long",
  behind: "Off: too much waits for it",
  by_user: "Off",
};

/** Return whether a webhook works, as an element. */
export function standing({ active, disabled_reason: reason, failing_since: failing }) {
  if (!active) return state("canceled", OFF[reason] ?? "Off");
  return failing ? state("warning", "Failing") : state("ok", "Works");
}

/** Say what a webhook is told of. */
export function toldOf({ events, kinds: chosen }, kinds) {
  const what = events.length ? events.map((event) => EVENTS[event] ?? event).join(", ") : "everything";
  const which = chosen.map((kind) => kinds.get(kind)?.title ?? kind).join(", ");
  return plain(which ? `${what}; only of: ${which}` : what);
}

/** Ask for an address and what it is told; resolves to the webhook, whose secret was shown, or null. */
export async function askForWebhook(kinds) {
  const form = fields({ url: "", events: [], kinds: [] }, kinds);
  const made = await ask({
    title: "Add a webhook",
    body: form.body,
    agree: "Add it",
    act: () => post("/v1/webhooks", form.read()),
  });
  return made && tellSecret(made);
}

/** Ask for another address or filter; resolves to the webhook as it is then, or null. */
export function askToChange(webhook, kinds) {
  const form = fields(webhook, kinds);
  return ask({
    title: "Change the webhook",
    body: form.body,
    agree: "Change it",
    act: () => change(webhook.id, form.read()),
  });
}

/** Change a webhook and return it. */
export async function change(id, json) {
  return patch(`/v1/webhooks/${id}`, json);
}

/** Show a webhook's new secret, the only time that it is told; resolves to the webhook. */
export async function tellSecret(webhook) {
  const text = h("input", {
    type: "text",
    readonly: true,
    value: webhook.secret,
    "aria-label": "The secret",
    class: "mono",
    onfocus: () => text.select(),
  });
  await ask({
    title: "The webhook's secret",
    body: [
      h("p", {}, "Its receiver verifies signatures by it. Copy it now: it is not shown again."),
      text,
    ],
    agree: "I have it",
    act: () => true,
  });
  return webhook;
}

function fields(given, kinds) {
  const url = h("input", {
    type: "url",
    required: true,
    value: given.url,
    autocomplete: "off",
    spellcheck: "false",
  });
  const events = choices("What happens (none: everything)", Object.entries(EVENTS), given.events);
  const titles = [...kinds.values()].map(({ kind, title }) => [kind, title]);
  const ofKinds = choices("Only of these jobs (none: all)", titles, given.kinds);
  return {
    body: [h("label", { class: "field" }, h("span", {}, "Address"), url), events.element, ofKinds.element],
    read: () => ({ url: url.value, events: events.chosen(), kinds: ofKinds.chosen() }),
  };
}

function choices(title, entries, given) {
  const boxes = entries.map(([value, words]) => {
    const box = h("input", { type: "checkbox", value });
    box.checked = given.includes(value);
    return { box, label: h("label", { class: "check-field" }, box, plain(words)) };
  });
  return {
    element: h("fieldset", {}, h("legend", {}, h("strong", {}, title)), h("div", { class: "options" }, boxes.map(({ label }) => label))),
    chosen: () => boxes.filter(({ box }) => box.checked).map(({ box }) => box.value),
  };
}
