// Asking again and again, without bothering anybody when nobody looks.

import { pause } from "./api.js";

const LONGEST_MS = 30_000;

/**
 * Run `action` now and then every `ms` until `signal` is aborted.
 *
 * While the window is hidden it waits; after an error pauses grow. The first run's error is thrown,
 * so that a view can say why it has nothing to show; a problem of a later one only if it is final
 * (something was deleted), and then it is given to `failed`.
 */
export async function repeat(action, ms, signal, failed = () => {}) {
  await action();
  go();

  async function go() {
    let errors = 0;
    while (!signal.aborted) {
      try {
        await pause(Math.min(ms * 2 ** errors, Math.max(ms, LONGEST_MS)), signal);
        await visible(signal);
        await action();
        errors = 0;
      } catch (error) {
        if (signal.aborted) return;
        if (error.status === 404 || error.name !== "ApiProblem") {
          failed(error);
          return;
        }
        errors++;
      }
    }
  }
}

/** Wait until the window is seen. */
export function visible(signal) {
  if (!document.hidden) return null;
  return new Promise((resolve) => {
    document.addEventListener("visibilitychange", resolve, { once: true, signal });
    signal.addEventListener("abort", resolve, { once: true });
  });
}
