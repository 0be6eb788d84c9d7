// The result of a job, for people: a verdict with its findings, a picture, figures, a rig.

import { h } from "../dom.js";
import { capturesById } from "../library.js";
import { navigate } from "../navigate.js";
import { isMarkerSet } from "../scan_files.js";
import { count, figure, plain } from "../words.js";
import { film, picture } from "./files.js";
import { rigFindings, verdictOf } from "./certificate.js";
import { findingList, judgedLines } from "./findings.js";
import { askForJob } from "./new_job.js";
import { studioPlace } from "../studio/place.js";
import { verdictState } from "./state.js";
import { doing } from "./toast.js";

/** What the pictures of each kind show. */
const PICTURES = {
  "check.png": "What the check saw",
  "distance.png": "How far the registered face lies from the scan",
  "texture_views.png": "The textured skin beside the raw scan",
  "anatomy.png": "Skull and muscles inside the scan",
  "certificate.png": "The certificate of the fit",
  "neutral.png": "Photographs and the person that they were made into",
  "photo.png": "Photographs beside the fitted face, and where they differ",
  "animation.png": "Moments of the animation",
  "neck.png": "Head and neck with bones and muscles",
  "edit.png": "The person before and after the edits",
  "studio.png": "Some shapes of the rig",
};

/** What an animation measured of a video: a recording itself. */
const SIGNALS = "signals.csv";

/** Images that a rig wears: shown on it. */
const WORN = /^studio_.*\.png$/;

/** Return a panel for a job that succeeded; null for one that has nothing to show. */
export function resultPanel(job, signal) {
  if (!job.result) return null;
  const { summary, artifacts, rig_id: rigId } = job.result;
  const has = (file) => artifacts.some(({ name }) => name === file);
  const isPlaced = job.kind === "check_markers" && job.rig_id && has("markers.json");
  const films = artifacts.filter(({ media_type: type }) => type.startsWith("video/"));
  const pictures = artifacts.filter(({ media_type: type }) => type === "image/png").filter(({ name }) => !WORN.test(name));
  const figures = [
    ...Object.entries(summary?.figures ?? summary ?? {}),
    ...Object.entries(summary?.all_markers ?? {}).map(([name, value]) => [`all markers, ${name}`, value]),
  ].filter(([name, value]) => (typeof value === "number" && name !== "format") || typeof value === "string");
  // of what was odd before a verdict was, without one
  const notices = (summary?.notices ?? []).map((notice) => ({ severity: "warning", ...notice }));
  const findings = [...notices, ...(summary?.findings ?? [])];
  const content = [
    summary?.verdict && h("p", { class: "verdict" }, rigId ? verdictOf(summary) : verdictState(summary.verdict, job.kind)),
    (summary?.findings || findings.length > 0) && findingList(findings),
    summary && judgedLines(summary),
    summary?.live && h("p", {}, liveLine(summary.live)),
    rigId && summary?.checks && findingList(rigFindings(summary)),
    rigId && h("p", {}, h("a", { class: "button", href: `/rigs/${rigId}` }, "Open the rig")),
    isPlaced && h("p", {}, h("a", { class: "button", href: `/markers/${job.id}` }, "Place the markers"), " ", goOn("Fit the take", () => fitTake(job))),
    has("sequence.npz") && h("p", {}, playOnRig(job), " ", goOn("Play it in a scene", () => playInScene(job))),
    has("animation.glb") && h("p", {}, playOnRig(job)),
    has(SIGNALS) && h("p", {}, goOn("Play its signals again", () => playSignals(job))),
    studioPlace(job, signal),
    films.map((artifact) => film(artifact, signal)),
    pictures.map((artifact) => picture(artifact, PICTURES[artifact.name] ?? artifact.name, signal)),
    figures.length > 0 &&
      h(
        "dl",
        { class: "facts" },
        figures.map(([name, value]) => [
          h("dt", {}, plain(name.replace(/_mm$/, ""))),
          h("dd", {}, shown(name, value)),
        ]),
      ),
  ]
    .flat()
    .filter(Boolean);
  if (!content.length) return null;
  return h(
    "section",
    { class: "panel stack", "aria-labelledby": "result" },
    h("h2", { id: "result" }, "Result"),
    content,
  );
}

function playOnRig(job) {
  return h("a", { class: "button", href: `/rigs/${job.rig_id}?take=${job.id}:0` }, "Play it on the rig");
}

/** Return a button that asks for the job that goes on with what this one left. */
function goOn(words, request) {
  const act = async () => {
    const next = await askForJob(await request());
    if (next) navigate(`/jobs/${next.id}`);
  };
  const button = h("button", { type: "button", onclick: () => doing(button, act) }, words);
  return button;
}

/** The fit of a checked take by the places that the check found, not by those it was checked against. */
async function fitTake(job) {
  const known = await capturesById(job.subject_id, job.captures);
  const captures = job.captures.filter((id) => known.has(id) && !isMarkerSet(known.get(id)));
  return { kind: "fit_markers", ...of(job), captures, from_jobs: [{ job: job.id, artifact: "markers.json" }] };
}

function playInScene(job) {
  const left = [{ job: job.id, artifact: "sequence.npz" }];
  // weights of shapes are played by tracks
  const drive = ["T", "B"].includes(job.result.summary?.system) ? { drive: "tracks" } : {};
  const options = { scene: { ...drive, performance: { asset: "sequence" } } };
  return { kind: "simulate", ...of(job), from_jobs: left, options };
}

/** The same scene by what was measured of its video, which is not looked at again. */
function playSignals(job) {
  const { scene } = job.options;
  const options = { ...job.options, scene: { ...scene, recording: { ...scene.recording, asset: "signals" } } };
  delete options.scene.recording.face; // which was meant in the video
  const left = [{ job: job.id, artifact: SIGNALS }];
  return { kind: "animate", ...of(job), captures: job.captures, from_jobs: left, options };
}

function of({ subject_id, rig_id }) {
  return { subject_id, rig_id };
}

/** Say how far the live session of a take was off its exact solution, beside what it told then. */
function liveLine({ take, frames, p50_mm: p50, p95_mm: p95, max_mm: most, max_frame: worst, told }) {
  if (!frames) return `Live had sent no face in these frames of ${take}.`;
  const said = told.p50_mm === null ? "At the end it had told nothing" : `At the end it told ${off(told.p50_mm, told.p95_mm)}`;
  return `Live was off ${off(p50, p95)}, at most ${figure(most)} mm in frame ${worst}, of ${count(frames, "frame")} of ${take}. ${said}.`;
}

function off(p50, p95) {
  return `${figure(p50)} mm, 95 % within ${figure(p95)}`;
}

function shown(name, value) {
  if (typeof value !== "number") return value;
  return figure(value) + (name.endsWith("_mm") ? " mm" : "");
}
