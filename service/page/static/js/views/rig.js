// A rig: the fitted face with its expressions, muscles, scans and what is inside.

import { h, show } from "../dom.js";
import { navigate, replaceQuery, title } from "../navigate.js";
import { heading } from "../rig/heading.js";
import { SYSTEMS, bySystem, firstSystem, rigAndView, systemsOf } from "../rig/read.js";

export async function mount(root, { id }, query) {
  const ending = new AbortController();
  const { signal } = ending;
  show(root, h("p", { class: "empty", role: "status" }, "Loading the face …"));
  // the rig comes while the code to show it does
  const [{ rig, subject, system, buffer }, { RigPage }, { Face }, { fromQuery, toQuery }] = await Promise.all([
    rigAndView(`${id}.${query.get("system")}`, signal),
    import("../rig/page.js"), import("../rig/face.js"), import("../rig/link.js"), import("../../vendor/three.js"),
  ]);
  title(`Rig of ${subject.name}`);
  const first = firstSystem(rig);
  if (!buffer && system !== first) {
    navigate(`/rigs/${id}`, { replace: true });
    return () => ending.abort();
  }
  if (!buffer) {
    show(root, heading(rig, subject), h("div", { class: "notice" },
      h("p", {}, "This rig was made before rigs could be shown here. Fit it again to see it; its files are at its job."),
      h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "To its job")));
    return () => ending.abort();
  }
  const page = new RigPage(bySystem(rig, system), new Face(buffer), fromQuery(query), signal);
  const address = (letter) => [letter !== first && `system=${letter}`, toQuery(page.state)].filter(Boolean).join("&");
  page.addEventListener("change", () => replaceQuery(address(system)));
  const choose = (letter) => navigate(`/rigs/${id}?${address(letter)}`);
  show(root, heading(rig, subject, [systemChoice(rig, system, choose), page.buttons]), page.element);
  page.start();
  performance.mark("rig-shown");
  return () => {
    ending.abort();
    page.dispose();
  };
}

/** Return a list of the systems that a rig can be shown by, and the way to two of them side by side. */
function systemChoice(rig, system, choose) {
  const letters = systemsOf(rig);
  if (letters.length === 1) return null;
  const first = firstSystem(rig);
  const other = system === first ? letters.find((letter) => letter !== first) : system;
  const select = h("select", { id: "system", onchange: () => choose(select.value) },
    letters.map((letter) => h("option", { value: letter, selected: letter === system }, SYSTEMS[letter] ?? letter)));
  return h("div", { class: "row" }, h("label", { for: select.id }, "Driven by"), select,
    h("a", { class: "button", href: `/compare?a=${rig.id}&b=${rig.id}.${other}` }, "Side by side"));
}
