// Uploads that have not become scans yet, remembered over a reload of the page.

const KEY = "myoface.uploads";
const KEPT_MS = 24 * 3600 * 1000; // the service forgets them after that time too

/** Return what is known of a file's upload, or null. */
export function find(file) {
  return read().find((entry) => entry.file === identity(file)) ?? null;
}

/** Remember a file's upload and whose scan it is to be. */
export function remember(file, uploadId, subjectId) {
  const entry = { file: identity(file), filename: file.name, uploadId, subjectId, at: Date.now() };
  write([...read().filter((other) => other.file !== entry.file), entry]);
}

/** Forget a file's upload: it became a scan, or was given up. */
export function forget(file) {
  write(read().filter((entry) => entry.file !== identity(file)));
}

/** Return all that is remembered. */
export function read() {
  try {
    const entries = JSON.parse(localStorage.getItem(KEY)) ?? [];
    return entries.filter(({ at }) => Date.now() - at < KEPT_MS);
  } catch {
    return [];
  }
}

function write(entries) {
  if (entries.length) localStorage.setItem(KEY, JSON.stringify(entries));
  else localStorage.removeItem(KEY);
}

function identity({ name, size, lastModified }) {
  return `${name} ${size} ${lastModified}`;
}
