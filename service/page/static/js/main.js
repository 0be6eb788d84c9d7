// The page's frame: signs in, keeps the bar at the top true, starts the router.

import * as auth from "./auth.js";
import { h, show } from "./dom.js";
import { myself } from "./library.js";
import { takeKey } from "./parts/foreign_key.js";
import { dropped } from "./scan_files.js";
import { time } from "./words.js";
import { navigate } from "./navigate.js";
import { start } from "./router.js";

const offered = auth.takeFromAddress();
if (offered && !auth.key()) auth.keep(offered); // before the first view asks for anything
addEventListener("hashchange", () => consider(auth.takeFromAddress()));

/** Take a key that came with a link, if the person wants it, and show the view anew. */
async function consider(key) {
  if (!key || key === auth.key()) return;
  const before = auth.key();
  await takeKey(key).catch((error) => console.warn(error.message));
  if (auth.key() !== before) navigate(location.pathname + location.search, { replace: true });
}

document.addEventListener("connection", ({ detail: isThere }) => {
  const place = document.getElementById("connection");
  place.dataset.state = isThere ? "there" : "gone";
  show(place, isThere ? "" : h("strong", {}, `No answer since ${time(new Date())}; trying again`));
});

document.addEventListener("keyneeded", ({ detail: problem }) => {
  if (location.pathname === "/sign-in") return;
  if (problem.code !== "auth.missing") auth.forget();
  const next = location.pathname + location.search;
  navigate(`/sign-in?${new URLSearchParams({ next, why: problem.code })}`, { replace: true });
});

/** Show whose key there is, and the ways to what it opens. */
async function showAccount() {
  const account = document.getElementById("account");
  account.textContent = auth.key() ? "Signed in" : "Sign in";
  const me = await myself().catch(() => null); // the view says what is wrong
  if (me) account.textContent = `Signed in: ${me.tenant}`;
  const scopes = new Set(me?.scopes);
  for (const link of document.querySelectorAll("nav a[data-scope]")) {
    link.hidden = !scopes.has(link.dataset.scope);
  }
}

document.addEventListener("uploads", ({ detail: open }) => {
  document.querySelector("nav a[href='/upload']").textContent = open ? `Upload (${open})` : "Upload";
});

// Files may be dropped on any view: they go to the upload's, which takes its own itself.
addEventListener("dragover", (event) => {
  if (event.dataTransfer.types.includes("Files")) event.preventDefault();
});
addEventListener("drop", async (event) => {
  if (!event.dataTransfer.types.includes("Files")) return;
  event.preventDefault();
  if (location.pathname === "/upload") return;
  const files = dropped(event.dataTransfer); // read before the event is over
  await navigate("/upload");
  document.dispatchEvent(new CustomEvent("filesdropped", { detail: await files }));
});

// What is refused in a form has to be seen before it can be mended.
document.addEventListener("invalid", ({ target }) => target.closest("details")?.setAttribute("open", ""), true);

document.addEventListener("keychange", showAccount);
showAccount();
start();
consider(offered);
