// A rig: the fitted face with its expressions, muscles, scans and what is inside.

import { h, show } from "../dom.js";
import { replaceQuery, title } from "../navigate.js";
import { heading } from "../rig/heading.js";
import { rigAndSubject, viewOf } from "../rig/read.js";

export async function mount(root, { id }, query) {
  const ending = new AbortController();
  const { signal } = ending;
  show(root, h("p", { class: "empty", role: "status" }, "Loading the face …"));
  // the rig comes while the code to show it does
  const [[rig, subject], buffer, { RigPage }, { Face }, { fromQuery, toQuery }] = await Promise.all([
    rigAndSubject(id, signal), viewOf(id, signal),
    import("../rig/page.js"), import("../rig/face.js"), import("../rig/link.js"), import("../../vendor/three.js"),
  ]);
  title(`Rig of ${subject.name}`);
  if (!buffer) {
    show(root, heading(rig, subject), h("div", { class: "notice" },
      h("p", {}, "This rig was made before rigs could be shown here. Fit it again to see it; its files are at its job."),
      h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "To its job")));
    return () => ending.abort();
  }
  const page = new RigPage(rig, new Face(buffer), fromQuery(query), signal);
  page.addEventListener("change", () => replaceQuery(toQuery(page.state)));
  show(root, heading(rig, subject, page.buttons), page.element);
  page.start();
  performance.mark("rig-shown");
  return () => {
    ending.abort();
    page.dispose();
  };
}

