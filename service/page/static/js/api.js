// Requests to the API: JSON in and out, problems as errors, a word to the page when nobody answers.

import * as auth from "./auth.js";

const PATIENCE_MS = 30_000;
const MOST_WAITS = 3;

/** An error that the API answered with, or that there was no answer (status 0). */
export class ApiProblem extends Error {
  constructor(document) {
    super(document.detail);
    this.name = "ApiProblem";
    this.status = document.status;
    this.code = document.code;
    this.document = document;
  }
}

/**
 * Send a request and return the response, if it is a good one.
 *
 * `body` is sent as it is, `json` as JSON. With `patience` null nothing but `signal` ends it.
 * Throws ApiProblem; an aborted `signal` throws its reason.
 */
export async function request(path, options = {}) {
  const { method = "GET", json, body = json && JSON.stringify(json), headers = {} } = options;
  const { signal, patience = PATIENCE_MS } = options;
  for (let waits = 0; ; waits++) {
    const response = await send(
      path,
      {
        method,
        body,
        headers: {
          ...(json ? { "Content-Type": "application/json" } : {}),
          ...headers,
          ...auth.headers(),
        },
        signal: anyOf(signal, patience),
        cache: "no-cache",
        redirect: "error",
      },
      signal,
    );
    if (response.ok) return response;
    if (response.status === 429 && waits < MOST_WAITS) {
      await pause(1000 * (Number(response.headers.get("Retry-After")) || 1), signal);
      continue;
    }
    throw await asProblem(response);
  }
}

async function send(path, init, signal) {
  try {
    const response = await fetch(path, init);
    noteTime(response);
    tell(true);
    return response;
  } catch (error) {
    if (signal?.aborted) throw signal.reason;
    tell(false);
    throw noAnswer(error.name === "TimeoutError" ? "did not answer in time" : "does not answer");
  }
}

function noAnswer(why) {
  return new ApiProblem({ status: 0, code: "page.no_answer", detail: `the service ${why}` });
}

/** Read the body of an answer, by default as JSON; one that breaks off is a problem like no answer. */
export function contentOf(response, signal = undefined, kind = "json") {
  return received(() => response[kind](), signal);
}

async function received(read, signal) {
  try {
    return await read();
  } catch (error) {
    if (signal?.aborted) throw signal.reason;
    throw noAnswer(error.name === "SyntaxError" ? "answered with something else" : "broke off its answer");
  }
}

async function asProblem(response) {
  let document;
  try {
    document = await response.json();
  } catch {
    document = {};
  }
  const problem = new ApiProblem({
    status: response.status,
    code: `http.${response.status}`,
    detail: `the service answered ${response.status} ${response.statusText}`,
    ...document,
  });
  if (response.status === 401)
    globalThis.document.dispatchEvent(new CustomEvent("keyneeded", { detail: problem }));
  return problem;
}

/** Get JSON; `query` is an object, whose empty members are left out. */
export async function get(path, query = {}, signal = undefined) {
  return contentOf(await request(withQuery(path, query), { signal }), signal);
}

/** Send JSON by POST and return the answer's. */
export async function post(path, json = undefined, signal = undefined) {
  return contentOf(await request(path, { method: "POST", json, signal }), signal);
}

/** Send JSON by PUT and return the answer's. */
export async function put(path, json, signal = undefined) {
  return contentOf(await request(path, { method: "PUT", json, signal }), signal);
}

/** Change something by PATCH and return it as it is now. */
export async function patch(path, json, signal = undefined) {
  return contentOf(await request(path, { method: "PATCH", json, signal }), signal);
}

/** Delete something. */
export async function remove(path, signal = undefined) {
  await request(path, { method: "DELETE", signal });
}

/** Get all items of a list, page by page; for lists that are short by nature. */
export async function all(path, query = {}, signal = undefined) {
  const items = [];
  let cursor = null;
  do {
    const page = await get(path, { limit: 1000, ...query, cursor }, signal);
    items.push(...page.items);
    cursor = page.next;
  } while (cursor);
  return items;
}

/** Get a file; `progress(received, total)` is called as it arrives (total 0: unknown). */
export async function bytes(path, { signal, progress } = {}) {
  const response = await request(path, { signal, patience: null });
  if (!progress) return contentOf(response, signal, "arrayBuffer");
  // what arrives is counted unpacked; a packed answer tells only its packed length
  const total = response.headers.has("Content-Encoding") ? 0 : Number(response.headers.get("Content-Length"));
  const parts = [];
  let count = 0;
  await received(async () => {
    for await (const part of chunks(response.body)) {
      parts.push(part);
      count += part.length;
      progress(count, total);
    }
  }, signal);
  return new Blob(parts).arrayBuffer();
}

/** Give what a stream brings, part by part. */
export async function* chunks(stream) {
  const reader = stream.getReader();
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

/** Return a path with a query, without the members that are empty. */
function withQuery(path, query) {
  const given = Object.entries(query).filter(
    ([, value]) => value !== null && value !== undefined && value !== "",
  );
  return given.length ? `${path}?${new URLSearchParams(given)}` : path;
}

/** Wait; an aborted signal ends it by its reason. */
export function pause(ms, signal = undefined) {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    const stop = () => {
      clearTimeout(timer);
      reject(signal.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", stop);
      resolve();
    }, ms);
    signal?.addEventListener("abort", stop, { once: true });
  });
}

let aheadMs = 0;

/** Return the service's time in ms: the operator's clock may be wrong. */
export function serverNow() {
  return Date.now() + aheadMs;
}

function noteTime(response) {
  const date = Date.parse(response.headers.get("Date") ?? "");
  // the header has whole seconds: a difference below two says nothing
  if (date) aheadMs = Math.abs(date - Date.now()) < 2000 ? 0 : date - Date.now();
}

let answered = null;

function tell(isThere) {
  if (answered === isThere) return;
  answered = isThere;
  document.dispatchEvent(new CustomEvent("connection", { detail: isThere }));
}

function anyOf(signal, patience) {
  const given = [signal, patience && AbortSignal.timeout(patience)].filter(Boolean);
  return given.length ? AbortSignal.any(given) : undefined;
}
