// The API key: from the address's fragment, which is never sent to a server, or typed.
// It lives as long as the tab.

const KEY = "myoface.key";

/**
 * Take a key out of the address (`#key=...`), so that it does not stay in the history. Returns it, null
 * if there is none; keeping it is another's decision: anybody can send a link with a key of his.
 */
export function takeFromAddress() {
  const match = /^#key=([^&]*)/.exec(location.hash);
  if (!match) return null;
  history.replaceState(history.state, "", location.pathname + location.search);
  try {
    return decodeURIComponent(match[1]).trim() || null;
  } catch {
    return null; // no key has a "%" of its own
  }
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

/** Return the headers that sign a request in, with this tab's key if no other is given. */
export function headers(text = key()) {
  return text ? { Authorization: `Bearer ${text}` } : {};
}
