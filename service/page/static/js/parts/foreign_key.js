// A key that came with a link: it is taken without a question only where there is no other.

import * as auth from "../auth.js";
import { h } from "../dom.js";
import { ask } from "./dialog.js";

/** Keep a key, after a question that names both studios if the tab has another one. */
export async function takeKey(offered) {
  if (!auth.key() || auth.key() === offered) {
    auth.keep(offered);
    return;
  }
  const [theirs, mine] = await Promise.all([studio(offered), studio(auth.key())]);
  if (theirs === null) return; // not a key of this service's: the tab's own stays
  if (mine === null) {
    auth.keep(offered);
    return;
  }
  await ask({
    title: `Sign in to ${theirs}?`,
    body: h(
      "p",
      {},
      "The link that was opened has a key of the studio ",
      h("strong", {}, theirs),
      ". This tab is signed in to ",
      h("strong", {}, mine),
      ". What is uploaded from now on would go to the other one.",
    ),
    agree: `Sign in to ${theirs}`,
    act: () => auth.keep(offered),
    danger: true,
  });
}

/** Return the name of a key's studio; null: the service does not know the key. */
async function studio(key) {
  // not by api.js: a key that is refused here is not the tab's, which stays signed in
  const answer = await fetch("/v1/me", { headers: auth.headers(key), redirect: "error" });
  if (answer.status === 401) return null;
  if (!answer.ok) throw new Error(`the service answered with ${answer.status}`);
  return (await answer.json()).tenant;
}
