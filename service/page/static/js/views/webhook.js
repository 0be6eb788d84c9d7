// One webhook: what it is told, and the log of what was sent.

import { get, post, remove } from "../api.js";
import { h, show } from "../dom.js";
import { kindsByName } from "../library.js";
import { ask } from "../parts/dialog.js";
import { Paged } from "../parts/paged.js";
import { state } from "../parts/state.js";
import { doing, toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { askToChange, change, standing, tellSecret, toldOf } from "../parts/webhook.js";
import { repeat } from "../repeat.js";
import { navigate } from "../navigate.js";
import { when } from "../words.js";

const EVERY_MS = 3_000;
const STATES = { pending: ["queued", "On its way"], delivered: ["good", "Delivered"], failed: ["failed", "Failed"] };

export async function mount(root, { id }) {
  const ending = new AbortController();
  const { signal } = ending;
  const [webhook, kinds] = await Promise.all([get(`/v1/webhooks/${id}`, {}, signal), kindsByName()]);
  const head = h("div", { class: "stack" });
  const list = new Paged({
    path: `/v1/webhooks/${id}/deliveries`,
    label: "Deliveries",
    columns: ["State", "Event", "Sent", "Answer", "Attempts", "(Actions)"],
    row: (delivery) => row(delivery, () => list.refresh()),
    empty: "Nothing was sent in the last 30 days.",
    signal,
  });
  const filter = h(
    "select",
    { onchange: () => list.first({ state: filter.value }).catch((error) => toast(sentence(error), "bad")) },
    h("option", { value: "" }, "All deliveries"),
    Object.entries(STATES).map(([key, [, words]]) => h("option", { value: key }, words)),
  );
  const showHead = (shown) => show(head, headOf(shown, kinds, showHead, () => list.first()));
  showHead(webhook);
  show(
    root,
    head,
    h("div", { class: "head" }, h("h2", { class: "grow" }, "Deliveries"), h("label", {}, h("span", { class: "unseen" }, "State"), filter)),
    list.elements,
  );
  await repeat(() => list.refresh(), EVERY_MS, signal, (error) => toast(sentence(error), "bad"));
  return () => ending.abort();
}

/** The webhook and what can be done with it; `changed(webhook)` shows it anew, `sent()` its log. */
function headOf(webhook, kinds, changed, sent) {
  const path = `/v1/webhooks/${webhook.id}`;
  const act = (words, action, kind = null) => {
    const button = h("button", { type: "button", class: kind, onclick: () => doing(button, action) }, words);
    return button;
  };
  const show = (next) => next && changed(next);
  return [
    h(
      "div",
      { class: "head" },
      h("h1", { class: "grow breaks" }, webhook.url),
      act("Send a test", async () => (await post(`${path}/test`)) && sent()),
      act("Change", async () => show(await askToChange(webhook, kinds))),
      act(webhook.active ? "Switch off" : "Switch on", async () => show(await change(webhook.id, { active: !webhook.active }))),
      act("New secret", async () => show(await askForSecret(path))),
      act("Delete", () => askToDelete(webhook, path), "danger"),
    ),
    h(
      "dl",
      { class: "facts" },
      [
        ["State", standing(webhook)],
        ["Is told of", toldOf(webhook, kinds)],
        ["Added", when(webhook.created_at)],
        ["Failing since", webhook.failing_since && when(webhook.failing_since)],
        ["Secret changed", webhook.rotated_at && when(webhook.rotated_at)],
      ]
        .filter(([, value]) => value)
        .map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]),
    ),
  ];
}

async function askForSecret(path) {
  const made = await ask({
    title: "Make a new secret?",
    body: h("p", {}, "For a day the old one signs too, so that the receiver can change over."),
    agree: "Make it",
    act: () => post(`${path}/rotate`),
  });
  return made && tellSecret(made);
}

async function askToDelete({ url }, path) {
  const done = await ask({
    title: "Delete the webhook?",
    body: h("p", { class: "breaks" }, `${url} is told nothing more. The log of what was sent goes too.`),
    agree: "Delete it",
    danger: true,
    act: async () => {
      await remove(path);
      return true;
    },
  });
  if (!done) return;
  toast("The webhook is deleted.");
  navigate("/webhooks");
}

function row(delivery, refresh) {
  const [key, words] = STATES[delivery.state];
  const again = h(
    "button",
    {
      type: "button",
      onclick: () => doing(again, async () => (await post(`/v1/deliveries/${delivery.id}/redeliver`)) && refresh()),
    },
    "Send again",
    h("span", { class: "unseen" }, ` ${delivery.type}, ${when(delivery.created_at)}`),
  );
  return h(
    "tr",
    {},
    h("td", { class: "tight" }, state(key, words)),
    h("th", { scope: "row" }, delivery.type, h("div", { class: "fine" }, about(delivery.data))),
    h("td", { class: "tight" }, when(delivery.created_at)),
    h("td", { class: "breaks" }, answer(delivery), delivery.excerpt && h("div", { class: "fine clip" }, delivery.excerpt)),
    h("td", { class: "tight" }, delivery.attempt),
    h("td", { class: "tight" }, delivery.state !== "pending" && again),
  );
}

function about({ job_id: job, batch_id: batch }) {
  if (job) return h("a", { href: `/jobs/${job}` }, "its job");
  return batch ? `session ${batch}` : null;
}

function answer({ state: at, status, ms, error, next_at: next }) {
  const parts = [
    status && `${status} after ${ms} ms`,
    error && error !== `http.${status}` && error,
    at === "pending" && next && `next try ${when(next)}`,
  ].filter(Boolean);
  return parts.length ? parts.join(", ") : "none yet";
}
