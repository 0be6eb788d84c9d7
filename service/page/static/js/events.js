// A job's server-sent events. EventSource cannot send the key in a header, so the stream is read
// by hand; it goes on after the last event when the connection breaks. Nobody looks at a hidden
// window: its stream is closed, since a browser has few connections to a service for all windows.

import { chunks, get, pause, request } from "./api.js";
import { FINAL } from "./parts/state.js";
import { visible } from "./repeat.js";

const SILENCE_MS = 45_000; // the service sends a comment more often than that
const PAUSE_MS = 2_000;

/**
 * Call `tell({id, event, data})` for each event after `after`, until the job is over.
 *
 * Throws what `signal` was aborted with, and ApiProblem if the job is not there.
 */
export async function watch(jobId, { after = 0, signal, tell }) {
  let last = after;
  for (;;) {
    await visible(signal);
    try {
      for await (const event of stream(jobId, last, signal)) {
        last = event.id;
        tell(event);
        if (event.event === "state" && FINAL.has(event.data.state)) return;
      }
      // ended without a last word: a proxy cut it, or the job was over before
      if (FINAL.has((await get(`/v1/jobs/${jobId}`, {}, signal)).state)) return;
    } catch (error) {
      signal.throwIfAborted();
      // 429: too many windows watch; the next try may find one closed
      if (error.status >= 400 && error.status < 500 && error.status !== 429) throw error;
    }
    await pause(PAUSE_MS, signal);
  }
}

async function* stream(jobId, after, signal) {
  const closing = new AbortController();
  let timer;
  const heard = () => {
    clearTimeout(timer);
    timer = setTimeout(() => closing.abort(), SILENCE_MS);
  };
  const hide = () => document.hidden && closing.abort();
  document.addEventListener("visibilitychange", hide);
  heard();
  try {
    const response = await request(`/v1/jobs/${jobId}/events`, {
      headers: { "Last-Event-ID": String(after) },
      signal: AbortSignal.any([signal, closing.signal]),
      patience: null,
    });
    yield* parsed(response.body, heard);
  } finally {
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", hide);
  }
}

/** Read the text format of server-sent events from a stream of bytes. */
async function* parsed(body, heard) {
  const decoder = new TextDecoder();
  let text = "";
  for await (const part of chunks(body)) {
    heard();
    text += decoder.decode(part, { stream: true });
    const blocks = text.split(/\r?\n\r?\n/);
    text = blocks.pop();
    for (const block of blocks) {
      const event = parse(block);
      if (event) yield event;
    }
  }
}

function parse(block) {
  const fields = { event: "message", id: "0", data: [] };
  for (const line of block.split(/\r?\n/)) {
    const [, name, value] = /^([^:]*):? ?(.*)$/.exec(line);
    if (name === "data") fields.data.push(value);
    else if (name in fields) fields[name] = value;
  }
  if (!fields.data.length) return null; // a comment that keeps the connection open
  return { id: Number(fields.id), event: fields.event, data: JSON.parse(fields.data.join("\n")) };
}
