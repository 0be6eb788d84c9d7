// The place of a studio's rig among a job's results: its file and images are fetched as the panel is made.

import { bytes, contentOf, request } from "../api.js";
import { h, show } from "../dom.js";
import { sentence } from "../parts/trouble.js";

const FILE = "studio.glb";

/** Return an element that shows the rig of a `build_studio_rig` job; null if the job left none. */
export function studioPlace({ result }, signal) {
  const { artifacts, summary } = result;
  const file = artifacts.find(({ name }) => name === FILE);
  if (!file) return null;
  const place = h("div", {}, h("p", { class: "empty", role: "status" }, "Loading the rig …"));
  load(place, file, summary, artifacts, signal).catch((error) => {
    if (!signal.aborted) show(place, h("p", { class: "notice bad", role: "alert" }, sentence(error)));
  });
  return place;
}

async function load(place, file, told, artifacts, signal) {
  const maps = Object.entries(told.wrinkles ?? {}).map(async ([name, { file: image }]) => {
    const { id } = artifacts.find((each) => each.name === image);
    const response = await request(`/v1/artifacts/${id}`, { signal });
    return [name, await contentOf(response, signal, "blob")];
  });
  const [{ StudioModel }, { StudioView }, buffer, ...wrinkles] = await Promise.all([
    import("./model.js"), import("./view.js"), bytes(`/v1/artifacts/${file.id}`, { signal }), ...maps,
  ]);
  const model = await StudioModel.read(buffer, told, new Map(wrinkles));
  if (signal.aborted) return;
  const view = new StudioView(model);
  show(place, view.element);
  view.start();
  signal.addEventListener("abort", () => view.dispose());
  performance.mark("studio-shown");
}
