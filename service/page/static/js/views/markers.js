// Where a take's markers sit on a person: proposed by a check, put right by hand, saved as a set.

import { bytes, get, post } from "../api.js";
import { h, show } from "../dom.js";
import { capturesById, changed } from "../library.js";
import { navigate, title } from "../navigate.js";
import { rigAndSubject, viewOf } from "../rig/read.js";
import { toast } from "../parts/toast.js";
import { upload } from "../tus.js";

const FILE = "markers.json";

export async function mount(root, { id }) {
  const ending = new AbortController();
  const { signal } = ending;
  show(root, h("p", { class: "empty", role: "status" }, "Loading the face …"));
  const job = await get(`/v1/jobs/${id}`, {}, signal);
  const artifact = job.result?.artifacts.find(({ name }) => name === FILE);
  if (!artifact || !job.rig_id) {
    show(root, h("h1", {}, "Markers"), h("div", { class: "notice" },
      h("p", {}, "This check proposes no places: it needs a rig, and a take that can be used."),
      h("a", { class: "button", href: `/jobs/${id}` }, "To the check")));
    return () => ending.abort();
  }
  const [[rig, subject], buffer, packed, captures, { BindingPage }, { Face }, { MarkerSet }] = await Promise.all([
    rigAndSubject(job.rig_id, signal), viewOf(job.rig_id, signal),
    bytes(`/v1/artifacts/${artifact.id}`, { signal }), capturesById(job.subject_id, job.captures),
    import("../rig/binding_page.js"), import("../rig/face.js"), import("../rig/marker_set.js"), import("../../vendor/three.js"),
  ]);
  const take = job.captures.map((each) => captures.get(each)).find((each) => each && !each.filename.toLowerCase().endsWith(".json"));
  const face = new Face(buffer);
  const set = new MarkerSet(JSON.parse(new TextDecoder().decode(packed)), face);
  title(`Markers of ${subject.name}`);
  const page = new BindingPage(face, set, (changedSet) => save(changedSet, subject, take?.name ?? "take", [...captures.values()]));
  show(root,
    h("header", { class: "head" },
      h("h1", { class: "grow" }, "Markers of ", h("a", { href: `/subjects/${subject.id}` }, subject.name)),
      h("a", { class: "button", href: `/rigs/${rig.id}` }, "The rig"),
      h("a", { class: "button", href: `/jobs/${id}` }, "The check")),
    page.element);
  page.start(signal);
  return () => {
    ending.abort();
    page.dispose();
  };
}

async function save(set, subject, take, captures) {
  const taken = new Set(captures.map(({ name }) => name.toLowerCase()));
  let name = `${take}-set`.slice(-64);
  for (let number = 2; taken.has(name.toLowerCase()); number++) name = `${take}-set-${number}`.slice(-64);
  const file = new File([JSON.stringify(set, null, 2)], `${name}.json`, { type: "application/json" });
  const nothing = () => {};
  const uploadId = await upload(file, { started: nothing, progress: nothing, waiting: nothing });
  await post(`/v1/subjects/${subject.id}/captures`, { name, role: "markers", upload_id: uploadId });
  changed(subject.id);
  toast(`The marker set is saved as ${name}: name it beside a take to fit that.`);
  navigate(`/subjects/${subject.id}`);
}
