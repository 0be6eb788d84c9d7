// Reading a rig from the API.

import * as api from "../api.js";

/** Return a rig and its subject. */
export async function rigAndSubject(id, signal) {
  const rig = await api.get(`/v1/rigs/${id}`, {}, signal);
  return [rig, await api.get(`/v1/subjects/${rig.subject_id}`, {}, signal)];
}

/** Return a rig's `view.bin`; null if the rig is older than such files. */
export async function viewOf(id, signal) {
  try {
    return await api.bytes(`/v1/rigs/${id}/artifacts/view.bin`, { signal });
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
