// Health: whether the parts answer, who works, how much waits, what is accepted.

import { ApiProblem, get } from "../api.js";
import { h, show } from "../dom.js";
import { kindsByName, serviceLimits } from "../library.js";
import { panel, table } from "../parts/frame.js";
import { state } from "../parts/state.js";
import { repeat } from "../repeat.js";
import { bytes, span, time, when } from "../words.js";

const EVERY_MS = 10_000;
const LEAST_KNOWN = 5;
const LEAST_USUAL_S = 30;
const PARTS = { database: "Database", broker: "Broker", files: "Files" };
const SWEEPER = {
  ok: () => state("ok", "Works"),
  silent: () => state("usable", "Silent for a minute: lost jobs and deleted files wait"),
};

export async function mount(root) {
  const ending = new AbortController();
  const { signal } = ending;
  const [limits, kinds] = await Promise.all([serviceLimits(), kindsByName()]);
  const overall = h("div", { role: "status" });
  const parts = h("tbody");
  const workers = h("tbody");
  const queues = h("tbody");
  const usage = h("tbody");
  const slow = h("div");
  const asked = h("p", { class: "fine grow" });
  root.append(
    h("div", { class: "head" }, h("h1", {}, "Health"), asked),
    overall,
    slow,
    h(
      "div",
      { class: "even" },
      panel("parts", "Parts", table(["Part", "State"], parts)),
      panel("queues", "Queues", table(["Queue", "Running", "Place of the newest job"], queues)),
      panel("workers", "Workers", table(["Worker", "Queue", "Since", "Last seen"], workers)),
      panel("usage", "What this studio uses", table(["(What)", "Used", "At most"], usage)),
      panel("limits", "Limits", limitList(limits)),
    ),
  );
  let toldReady = null;
  const refresh = async () => {
    const [{ ready, checks, workers: serving, sweeper }, living, lengths, used] = await Promise.all([
      readiness(signal),
      livingWorkers(signal),
      queueLengths(kinds, signal),
      get("/v1/usage", {}, signal),
    ]);
    if (toldReady !== ready) {
      toldReady = ready;
      show(
        overall,
        h(
          "div",
          { class: `notice ${ready ? "good" : "bad"}` },
          h(
            "p",
            {},
            h(
              "strong",
              {},
              ready
                ? "All parts answer."
                : "A part does not answer. Jobs and uploads may fail until it does.",
            ),
          ),
        ),
      );
    }
    show(parts, [
      ...Object.entries(checks).map(([name, found]) =>
        partRow(PARTS[name] ?? name, state(found, found === "ok" ? "Answers" : "Does not answer")),
      ),
      partRow("Sweeper", SWEEPER[sweeper]?.() ?? "unknown"),
    ]);
    show(workers, workerRows(living, serving));
    show(usage, usageRows(used));
    show(queues, queueRows(lengths, serving));
    show(slow, slowNotice(await slowJobs(lengths.running, kinds, signal)));
    asked.textContent = `as of ${time(new Date())}`;
  };
  await repeat(refresh, EVERY_MS, signal);
  return () => ending.abort();
}

function partRow(name, found) {
  return h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, found));
}

/** Ask the service how it is; that it is not ready is an answer too. */
async function readiness(signal) {
  try {
    return await get("/readyz", {}, signal);
  } catch (error) {
    if (error instanceof ApiProblem && error.document.checks) return error.document;
    throw error;
  }
}

/**
 * Return the running jobs that take longer than twice what most of their kind took lately; of a kind
 * with few that are known, than half of what it may take.
 */
async function slowJobs(running, kinds, signal) {
  const usual = new Map();
  for (const kind of new Set(running.map((job) => job.kind))) {
    const query = { kind, state: "succeeded", limit: 50 };
    const { items } = await get("/v1/jobs", query, signal);
    const taken = items.map((job) => lasted(job, job.finished_at)).sort((a, b) => a - b);
    const known = 2 * taken[Math.ceil(0.95 * taken.length) - 1];
    const most = (kinds.get(kind)?.max_seconds ?? Infinity) / 2;
    usual.set(kind, taken.length < LEAST_KNOWN ? most : Math.max(known, LEAST_USUAL_S));
  }
  return running.filter((job) => lasted(job, new Date()) > usual.get(job.kind));
}

/** Return the seconds that a job's last attempt has taken. */
function lasted(job, end) {
  return (new Date(end) - new Date(job.attempts.at(-1)?.started_at ?? job.started_at)) / 1000;
}

function slowNotice(jobs) {
  if (!jobs.length) return "";
  return h(
    "div",
    { class: "notice" },
    h("p", {}, h("strong", {}, "These take longer than usual.")),
    h(
      "ul",
      {},
      jobs.map((job) =>
        h("li", {}, h("a", { href: `/jobs/${job.id}` }, job.kind), `, for ${span(lasted(job, new Date()))}`),
      ),
    ),
  );
}

/** Return the living workers; null if the key may not see them. */
async function livingWorkers(signal) {
  try {
    return (await get("/v1/workers", {}, signal)).items;
  } catch (error) {
    if (error.status === 403) return null;
    throw error;
  }
}

/** Return by queue how many jobs run, and the place of the newest that waits: how long the queue is. */
async function queueLengths(kinds, signal) {
  const lengths = new Map([...kinds.values()].map(({ queue }) => [queue, { running: 0, place: 0 }]));
  const queueOf = (job) => lengths.get(kinds.get(job.kind)?.queue);
  const [running, ...newest] = await Promise.all([
    get("/v1/jobs", { state: "running", limit: 1000 }, signal),
    ...[...kinds.keys()].map((kind) => get("/v1/jobs", { state: "queued", kind, limit: 1 }, signal)),
  ]);
  for (const job of running.items) if (queueOf(job)) queueOf(job).running++;
  lengths.running = running.items;
  for (const job of newest.flatMap(({ items }) => items)) {
    const queue = queueOf(job);
    // one that was not put off has no place while it is far behind
    const unknown = job.not_before ? 0 : Infinity;
    if (queue) queue.place = Math.max(queue.place, job.queue_position ?? unknown);
  }
  return lengths;
}

function queueRows(lengths, serving) {
  return [...lengths].sort().map(([name, { running, place }]) => {
    return h(
      "tr",
      {},
      h(
        "th",
        { scope: "row" },
        name,
        !serving[name] && h("div", {}, state("usable", "No worker: its jobs wait")),
      ),
      h("td", {}, running),
      h("td", {}, place === Infinity ? "beyond 1,000" : place || "none waits"),
    );
  });
}

function usageRows(used) {
  const rows = [
    ["bytes", "Stored", bytes],
    ["running", "Running jobs", String],
    ["queued", "Queued jobs", String],
  ].map(([key, name, text]) =>
    h(
      "tr",
      {},
      h("th", { scope: "row" }, name),
      h("td", {}, text(used[key].used)),
      h("td", {}, used[key].limit === null ? "no limit" : text(used[key].limit)),
    ),
  );
  const lost = used.lost_files;
  const words = lost ? state("failed", `${lost}: the operator can restore them from a backup`) : "none";
  rows.push(h("tr", {}, h("th", { scope: "row" }, "Lost or damaged files"), h("td", { colspan: 2 }, words)));
  return rows;
}

function workerRows(workers, serving) {
  if (!Object.keys(serving).length)
    return h("tr", {}, h("td", { colspan: 4 }, state("failed", "No worker is alive: jobs wait.")));
  if (!workers) {
    const words = Object.entries(serving)
      .map(([queue, number]) => `${number} for ${queue}`)
      .join(", ");
    return h("tr", {}, h("td", { colspan: 4 }, `${words}. This key may not see their names.`));
  }
  return workers.map(({ name, queue, started_at: started, seen_at: seen }) =>
    h(
      "tr",
      {},
      h("th", { scope: "row", class: "breaks" }, name),
      h("td", {}, queue),
      h("td", {}, when(started)),
      h("td", {}, time(seen)),
    ),
  );
}

function limitList(limits) {
  return h(
    "dl",
    { class: "facts" },
    [
      ["Largest file", bytes(limits.max_upload_bytes)],
      ["An unused upload is kept", span(limits.upload_ttl)],
      ["Attempts a job may cost", limits.max_attempts],
      ["Registered scans", limits.scan_formats.join(" ")],
      ["Raw scans", limits.raw_scan_formats.join(" ")],
      ["Landmarks", limits.landmark_formats.join(" ")],
    ].map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]),
  );
}
