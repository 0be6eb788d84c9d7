// A rig: the fitted face with its expressions, muscles, scans and what is inside.

import * as api from "../api.js";
import { h, show } from "../dom.js";
import { replaceQuery, title } from "../router.js";
import { Face } from "../rig/face.js";
import { heading } from "../rig/heading.js";
import { fromQuery, toQuery } from "../rig/link.js";
import { RigPage } from "../rig/page.js";

export async function mount(root, { id }, query) {
  const ending = new AbortController();
  const { signal } = ending;
  show(root, h("p", { class: "empty", role: "status" }, "Loading the face …"));
  const [rig, buffer] = await Promise.all([
    api.get(`/v1/rigs/${id}`, {}, signal),
    api.bytes(`/v1/rigs/${id}/artifacts/view.bin`, { signal }).catch(notThere),
  ]);
  const subject = await api.get(`/v1/subjects/${rig.subject_id}`, {}, signal);
  title(`Rig of ${subject.name}`);
  if (!buffer) {
    show(root, heading(rig, subject), h("div", { class: "notice" },
      h("p", {}, "This rig was made before rigs could be shown here. Fit it again to see it; its files are at its job."),
      h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "To its job")));
    return () => ending.abort();
  }
  const page = new RigPage(rig, new Face(buffer), fromQuery(query), signal);
  page.addEventListener("change", () => replaceQuery(toQuery(page.state)));
  show(root, heading(rig, subject), page.element);
  page.start();
  performance.mark("rig-shown");
  return () => {
    ending.abort();
    page.dispose();
  };
}

/** Let an artifact be missing; every other problem goes on. */
function notThere(problem) {
  if (problem.code === "artifact.unknown") return null;
  throw problem;
}
