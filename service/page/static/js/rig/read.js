// Reading a rig from the API.

import * as api from "../api.js";

/** Return a rig and its subject. */
export async function rigAndSubject(id, signal) {
  const rig = await api.get(`/v1/rigs/${id}`, {}, signal);
  return [rig, await api.get(`/v1/subjects/${rig.subject_id}`, {}, signal)];
}

const MUSCLES = "S";
/** What drives a face, by its letter in a rig's files. */
export const SYSTEMS = { [MUSCLES]: "Muscles", P: "Single tets", T: "Muscle tracks", B: "Plain shapes" };
const VIEW_FILE = /^view_([A-Z])\.bin$/;

/** Return the letters of the systems that a rig can be shown by. */
export function systemsOf({ artifacts }) {
  return [MUSCLES, ...artifacts.flatMap(({ name }) => VIEW_FILE.exec(name)?.slice(1) ?? [])];
}

/** Return the rig's id and the letter of a system that an address names, `ID.T`; null where it names none. */
export function idAndSystem(text) {
  const [id, system] = text.split(".");
  return [id, system in SYSTEMS ? system : null];
}

/** Return the letter of the system that a rig is shown by at first; rigs of before are shown by their muscles. */
export function firstSystem({ summary }) {
  return summary.system in SYSTEMS ? summary.system : MUSCLES;
}

/** Return a rig, its subject, the system that an address names or shows at first, and the file of its view. */
export async function rigAndView(text, signal) {
  const [id, asked] = idAndSystem(text);
  const reading = rigAndSubject(id, signal);
  const system = asked ?? firstSystem((await reading)[0]);
  const [[rig, subject], buffer] = await Promise.all([reading, viewOf(id, signal, system)]);
  return { rig, subject, system, buffer };
}

/** Return a rig as one of its systems has it: certificate and inside are those of its muscles. */
export function bySystem(rig, system) {
  if (system === MUSCLES) return rig;
  const artifacts = rig.artifacts.filter(({ name }) => name !== "inside.bin");
  return { ...rig, artifacts, summary: { ...rig.summary, train_mean_mm: null, test_mean_mm: null, inverted: null } };
}

/** Return the file that shows a rig by a system; null if the rig does not have it. */
export async function viewOf(id, signal, system = MUSCLES) {
  const file = system === MUSCLES ? "view.bin" : `view_${system}.bin`;
  try {
    return await api.bytes(`/v1/rigs/${id}/artifacts/${file}`, { signal });
  } catch (problem) {
    if (problem.code === "artifact.unknown") return null;
    throw problem;
  }
}

/** Return the files called `name` of the jobs of a kind that have a rig as parent, newest first. */
export async function artifactsOfJobs(rig, kind, name, signal) {
  const listed = await api.all("/v1/jobs", { subject_id: rig.subject_id, kind, state: "succeeded" }, signal);
  const own = listed.filter((job) => job.rig_id === rig.id);
  const jobs = await Promise.all(own.map(({ id }) => api.get(`/v1/jobs/${id}`, {}, signal)));
  return jobs.flatMap((job) => {
    const artifact = job.result?.artifacts.find((each) => each.name === name);
    return artifact ? [{ job, artifact }] : [];
  });
}
