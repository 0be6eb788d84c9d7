// The address of the page: going to a path, the address's query, the window's title. The router shows
// what is asked for here; views and parts know this module and not the router.

let open = () => {};

/** Have `listener(options)` called after each change of place. */
export function onNavigate(listener) {
  open = listener;
}

/** Go to a path of the page; with `replace` the place before is forgotten. */
export function navigate(path, { replace = false } = {}) {
  history[replace ? "replaceState" : "pushState"](null, "", path);
  scrollTo(0, 0);
  return open({ focus: true });
}

/** Change the address's query without showing the view anew: a permalink that follows a control. */
export function replaceQuery(query) {
  const text = query.toString();
  history.replaceState(history.state, "", location.pathname + (text ? `?${text}` : ""));
}

/** Name the page, in the window's title. */
export function title(text) {
  document.title = text ? `${text} · Myoface` : "Myoface";
}
