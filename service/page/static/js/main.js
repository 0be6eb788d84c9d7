// The page's frame: signs in, keeps the bar at the top true, starts the router.

import * as auth from "./auth.js";
import { h, show } from "./dom.js";
import { myScopes } from "./library.js";
import { dropped } from "./scan_files.js";
import { time } from "./words.js";
import { navigate } from "./navigate.js";
import { start } from "./router.js";

auth.takeFromAddress();
addEventListener("hashchange", () => {
  if (auth.takeFromAddress()) navigate(location.pathname + location.search, { replace: true });
});

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

/** Show whether there is a key, and the ways to what it opens. */
async function showAccount() {
  document.getElementById("account").textContent = auth.key() ? "Signed in" : "Sign in";
  const scopes = await myScopes().catch(() => new Set()); // the view says what is wrong
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

document.addEventListener("keychange", showAccount);
showAccount();
start();
