// The API key: from the address's fragment, which is never sent to a server, or typed.
// It lives as long as the tab.

const KEY = "myoface.key";

/**
 * Take a key out of the address (`#key=...`), so that it does not stay in the history. Returns
 * whether there was one.
 */
export function takeFromAddress() {
  const match = /^#key=([^&]+)/.exec(location.hash);
  if (!match) return false;
  history.replaceState(history.state, "", location.pathname + location.search);
  keep(decodeURIComponent(match[1]));
  return true;
}

/** Return the key, or null. */
export function key() {
  return sessionStorage.getItem(KEY);
}

/** Keep a key for this tab. */
export function keep(text) {
  sessionStorage.setItem(KEY, text.trim());
  document.dispatchEvent(new Event("keychange"));
}

/** Forget the key. */
export function forget() {
  sessionStorage.removeItem(KEY);
  document.dispatchEvent(new Event("keychange"));
}

/** Return the headers that sign a request in; none without a key. */
export function headers() {
  const text = key();
  return text ? { Authorization: `Bearer ${text}` } : {};
}
