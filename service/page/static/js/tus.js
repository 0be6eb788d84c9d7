// Resumable uploads (tus 1.0): pieces with a checksum each, going on where the service stopped
// counting after whatever came in between.

import { ApiProblem, pause, request } from "./api.js";

const PIECE = 8 * 1024 * 1024;
const PIECE_PATIENCE_MS = 120_000;
const LONGEST_PAUSE_MS = 15_000;
const MOST_DAMAGED = 3;
const VERSION = { "Tus-Resumable": "1.0.0" };

/** Whether pieces can be checked: browsers compute sha256 only over https and on this machine. */
export const CAN_CHECK = Boolean(globalThis.crypto?.subtle);

/**
 * Send a file and return its upload's id.
 *
 * `known` is the id of an earlier attempt, `started(id)` is called with a new one, `progress(bytes)`
 * whenever more has arrived and `waiting(problem)` while the service does not answer. Throws
 * ApiProblem for what will not get better, and what `signal` was aborted with.
 */
export async function upload(file, { known = null, started, progress, waiting, signal }) {
  const retry = (action) => patiently(action, waiting, signal);
  const ask = (id) => patiently(() => where(id, signal), waiting, signal, settles);
  let id = known;
  let offset = known === null ? null : await ask(known);
  if (offset === null) {
    id = await retry(() => create(file, signal));
    offset = 0;
    started(id);
  }
  progress(offset);
  let damaged = 0;
  while (offset < file.size) {
    try {
      offset = await retry(() => send(id, file, offset, signal));
    } catch (error) {
      if (error.code === "upload.checksum" && ++damaged < MOST_DAMAGED) continue;
      if (error.code !== "upload.offset") throw error;
      offset = await ask(id); // another answer than we heard: ask
      if (offset === null) throw error;
    }
    progress(offset);
  }
  return id;
}

/** Give an upload up. */
export async function forget(id) {
  await request(`/v1/uploads/${id}`, { method: "DELETE", headers: VERSION });
}

async function create(file, signal) {
  const response = await request("/v1/uploads", {
    method: "POST",
    headers: {
      ...VERSION,
      "Upload-Length": String(file.size),
      "Upload-Metadata": `filename ${base64(new TextEncoder().encode(file.name))}`,
    },
    signal,
  });
  return response.headers.get("Location").split("/").pop();
}

/** Return how many bytes have arrived; null if the upload is no longer there. */
async function where(id, signal) {
  try {
    const response = await request(`/v1/uploads/${id}`, { method: "HEAD", headers: VERSION, signal });
    return Number(response.headers.get("Upload-Offset"));
  } catch (error) {
    if (error.status === 404 || error.status === 410) return null;
    throw error;
  }
}

async function send(id, file, offset, signal) {
  const piece = await read(file.slice(offset, offset + PIECE));
  const response = await request(`/v1/uploads/${id}`, {
    method: "PATCH",
    headers: {
      ...VERSION,
      "Content-Type": "application/offset+octet-stream",
      "Upload-Offset": String(offset),
      ...(CAN_CHECK
        ? { "Upload-Checksum": `sha256 ${base64(await crypto.subtle.digest("SHA-256", piece))}` }
        : {}),
    },
    body: piece,
    signal,
    patience: PIECE_PATIENCE_MS,
  });
  return Number(response.headers.get("Upload-Offset"));
}

async function read(blob) {
  try {
    return await blob.arrayBuffer();
  } catch {
    throw new ApiProblem({
      status: 0,
      code: "page.unreadable",
      detail: "the file cannot be read any more: it was moved or changed",
    });
  }
}

/** Try again while the service does not answer, is overloaded or still writes what came before. */
async function patiently(action, waiting, signal, mends = passes) {
  for (let ms = 500; ; ms = Math.min(2 * ms, LONGEST_PAUSE_MS)) {
    try {
      const result = await action();
      waiting(null);
      return result;
    } catch (error) {
      if (!mends(error)) throw error;
      waiting(error);
    }
    await pause(ms, signal);
  }
}

/** Whether time mends an error: no answer in time, too many requests, another still writing. */
function passes({ code, status }) {
  return code === "page.no_answer" || [408, 423, 429].includes(status) || (status >= 500 && status !== 507);
}

/** Whether time mends an error of asking how far an upload is: it may just be made a file. */
function settles(error) {
  return error.status === 409 || passes(error);
}

function base64(bytes) {
  return btoa(String.fromCharCode(...new Uint8Array(bytes)));
}
