// The line to a live session: a ticket, a WebSocket, and again where it breaks.

import * as api from "../../api.js";
import { FrameReader } from "./frames.js";

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 8_000;
const HOPELESS = new Set([400, 403, 404, 409, 410, 422]); // answers that no waiting mends

/**
 * Watches a session. Events: `message` (detail: what the session said), `frame` (detail: a frame),
 * `line` (detail: true while there is one), `failed` (detail: the error that ended it).
 */
export class LiveFeed extends EventTarget {
  #id;
  #signal;
  #socket = null;
  #reader = null;
  /** Whether the session has ended. */
  isOver = false;
  #ending = new AbortController();

  constructor(id, signal) {
    super();
    this.#id = id;
    this.#signal = AbortSignal.any([signal, this.#ending.signal]);
    this.#signal.addEventListener("abort", () => this.#socket?.close());
  }

  /** Stay on the line until the session has ended, or `close`. */
  async open() {
    for (let ms = FIRST_PAUSE_MS; !this.isOver && !this.#signal.aborted;) {
      try {
        if (await this.#listen()) ms = FIRST_PAUSE_MS;
        if (!this.isOver) await api.pause(ms, this.#signal);
      } catch (error) {
        if (this.#signal.aborted) return;
        if (HOPELESS.has(error.status)) {
          this.#tell("failed", error);
          return;
        }
        await api.pause(ms, this.#signal).catch(() => {});
      }
      ms = Math.min(2 * ms, LONGEST_PAUSE_MS);
    }
  }

  /** Leave the line. */
  close() {
    this.#ending.abort();
  }

  /** Listen until the line breaks; returns whether there was one. */
  async #listen() {
    const { url } = await api.post(`/v1/live/${this.#id}/tickets`, { watch: true }, this.#signal);
    const address = new URL(url, location.href);
    address.protocol = address.protocol.replace("http", "ws");
    return new Promise((resolve) => {
      const socket = new WebSocket(address);
      this.#socket = socket;
      let was = false;
      socket.binaryType = "arraybuffer";
      socket.addEventListener("open", () => {
        was = true;
        this.#tell("line", true);
      });
      socket.addEventListener("message", ({ data }) => this.#hear(data));
      socket.addEventListener("close", () => {
        if (was) this.#tell("line", false);
        resolve(was);
      });
    });
  }

  #hear(data) {
    if (typeof data === "string") {
      const said = JSON.parse(data);
      if (said.type === "ready") this.#reader = new FrameReader(said.layout);
      if (said.type === "ended") this.isOver = true;
      this.#tell("message", said);
    } else if (this.#reader) this.#tell("frame", this.#reader.read(data));
  }

  #tell(name, detail) {
    if (!this.#signal.aborted) this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
