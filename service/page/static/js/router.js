// Shows the view of the address, and follows links and the browser's history without a reload.

import { announce, h, show } from "./dom.js";
import { navigate, onNavigate, title } from "./navigate.js";
import { match } from "./routes.js";
import { trouble } from "./parts/trouble.js";

const ID = /^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$/i;
const EXAMPLE = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11";

let dispose = null;
let place = null; // path and query of the view
let turn = 0; // a view that finishes mounting after the next navigation is dropped

onNavigate(open);

/** Start: show the view of the address. */
export function start() {
  document.addEventListener("click", follow);
  // a link to a place on the page is a change of place as well
  addEventListener("popstate", () => place !== here() && open());
  return open();
}

function here() {
  return location.pathname + location.search;
}

async function open({ focus = false } = {}) {
  const mine = ++turn;
  dispose?.();
  dispose = null;
  place = here();
  const main = document.getElementById("main");
  main.removeAttribute("aria-busy");
  const found = match(location.pathname);
  markNavigation();
  const root = h("div", { class: "view" });
  if (!found) {
    title("Not found");
    show(main, h("h1", {}, "Not found"), h("p", {}, "There is nothing at this address."));
    return;
  }
  title(found.route.title);
  if ("id" in found.params && !ID.test(found.params.id)) {
    show(main, noId(found.params.id));
    return;
  }
  show(main, root);
  main.setAttribute("aria-busy", "true");
  try {
    const [view] = await Promise.all([found.route.load(), withStyle(found.route.style)]);
    if (mine !== turn) return;
    const end = await view.mount(root, found.params, new URLSearchParams(location.search));
    if (mine !== turn) end?.();
    else dispose = end;
  } catch (error) {
    if (mine === turn)
      show(
        root,
        trouble(error, () => open({ focus: true })),
      );
  }
  if (mine !== turn) return;
  main.removeAttribute("aria-busy");
  if (focus) moveFocus(main);
}

/** Say that an address has no id where one belongs, and where to find what was meant. */
function noId(text) {
  const [, first] = location.pathname.split("/");
  const list = first === "markers" ? "/subjects" : `/${first}`; // marker sets have no list of their own
  return h(
    "div",
    { class: "notice bad", role: "alert" },
    h("h1", {}, "Not there"),
    h("p", {}, "The address ends in ", h("code", {}, text), ", which is no id. An id is 36 characters long, such as ", h("code", {}, EXAMPLE), "; part of it may have been lost when the address was copied."),
    h("a", { class: "button", href: list }, `All ${list === "/jobs" ? "jobs" : list.slice(1)}`),
  );
}

/** Have a style sheet, before what it is for is shown. */
function withStyle(href) {
  if (!href || document.querySelector(`link[href="${href}"]`)) return null;
  const link = h("link", { rel: "stylesheet", href });
  const loaded = new Promise((resolve) => {
    link.onload = link.onerror = resolve; // plain is better than nothing
  });
  document.head.append(link);
  return loaded;
}

/** Put the focus where reading begins, as a browser does on a new page. */
function moveFocus(main) {
  const heading = main.querySelector("h1");
  if (heading) heading.tabIndex = -1;
  (heading ?? main).focus({ preventScroll: true });
  announce(document.title);
}

function markNavigation() {
  for (const link of document.querySelectorAll("nav a")) {
    const path = link.getAttribute("href");
    const isHere =
      path === "/"
        ? /^\/(queue|jobs(\/.*)?)?$/.test(location.pathname)
        : location.pathname === path || location.pathname.startsWith(`${path}/`);
    if (isHere) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

function follow(event) {
  const link = event.target.closest?.("a[href]");
  const plain = event.button === 0 && !(event.metaKey || event.ctrlKey || event.shiftKey || event.altKey);
  if (!link || !plain || event.defaultPrevented || link.target || link.hasAttribute("download")) return;
  const url = new URL(link.href);
  if (url.origin !== location.origin || !match(url.pathname)) return;
  if (url.hash && url.pathname === location.pathname) return; // a place on this page
  event.preventDefault();
  navigate(url.pathname + url.search);
}
