// A rig without sliders: why, and the job that makes them.

import * as api from "../api.js";
import { h, show } from "../dom.js";
import { sentence } from "../parts/trouble.js";

const KIND = "build_preview";

/** Return elements that say whether the sliders of a rig are being made, or offer to make them. */
export async function missingPreview(rig, signal) {
  const jobs = await api.all("/v1/jobs", { subject_id: rig.subject_id, kind: KIND }, signal);
  const [newest] = jobs.filter((job) => job.rig_id === rig.id);
  if (newest && ["queued", "running"].includes(newest.state)) return [beingMade(newest)];
  const why = newest?.error ? `There are no muscle sliders: ${newest.error.message}.` : "This rig has no muscle sliders yet.";
  const place = h("div", { class: "stack" });
  const button = h("button", {
    type: "button",
    onclick: async () => {
      button.disabled = true;
      try {
        const order = { kind: KIND, subject_id: rig.subject_id, rig_id: rig.id };
        show(place, beingMade(await api.post("/v1/jobs", order, signal)));
      } catch (error) {
        button.disabled = false;
        if (!signal.aborted) show(place, h("p", { role: "alert" }, sentence(error)), button);
      }
    },
  }, "Make the sliders");
  show(place, h("p", {}, why), h("p", { class: "fine" }, "The solver simulates poses of its muscles, which takes some minutes."), button);
  return [place];
}

function beingMade(job) {
  return h("p", { role: "status" }, "The muscle sliders are being made: see ", h("a", { href: `/jobs/${job.id}` }, "their job"), ". Then open this rig again.");
}
