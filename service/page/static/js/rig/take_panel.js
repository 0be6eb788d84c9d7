// The scrubber of sequences that were fitted with a rig, and of animations that it played.

import * as api from "../api.js";
import { h, setText, show } from "../dom.js";
import { sentence } from "../parts/trouble.js";
import { plain, when } from "../words.js";
import { Contractions } from "./contractions.js";
import { ContractionLanes, Lanes } from "./lanes.js";
import { MarkerTake } from "./marker_take.js";
import { artifactsOfJobs } from "./read.js";
import { Take } from "./take.js";

const SEQUENCE = "sequence.glb";
const ANIMATION = "animation.glb";
/** The file that is played of each kind of job. */
const FILES = {
  fit_sequence: SEQUENCE, fit_markers: SEQUENCE, fit_photo: SEQUENCE, simulate: ANIMATION, animate: ANIMATION,
};
const MARKERS = "markers.bin";
const CONTRACTIONS = "contractions.bin";

/** Sequences and animations of a rig; `change(patch)` takes a part of a state, which names job and frame. */
export class TakePanel {
  #change;
  #count;
  #signal;
  #jobs = new Map();
  #takes = new Map();
  #shown = null;
  #playing = 0;
  #pick = h("select", { "aria-label": "Sequence", onchange: () => this.#go(this.#pick.value, 0) });
  #play = h("button", { type: "button", onclick: () => this.#toggle() }, "Play");
  #scrub = h("input", {
    type: "range", min: 0, max: 0, step: 1, value: 0, "aria-label": "Frame",
    oninput: () => this.#go(this.#shown, Number(this.#scrub.value)),
  });
  #place = h("output", {}, "");
  #about = h("p", { class: "fine" }, "");
  #lanes = new Lanes((frame) => this.#go(this.#shown, frame));
  #pulls = new ContractionLanes((frame) => this.#go(this.#shown, frame));

  constructor(count, change, signal) {
    this.#count = count;
    this.#change = change;
    this.#signal = signal;
    signal.addEventListener("abort", () => this.stop());
    this.element = h("div", { class: "pose" }, h("p", { class: "fine" }, "Looking for sequences …"));
  }

  /** Look for the sequences and animations of a rig. */
  async find(rig) {
    try {
      const found = await Promise.all(Object.entries(FILES).map(([kind, file]) => (
        artifactsOfJobs(rig, kind, file, this.#signal))));
      for (const each of found.flat()) this.#jobs.set(each.job.id, each);
    } catch (error) {
      if (!this.#signal.aborted) this.#fail(sentence(error));
      return;
    }
    if (this.#jobs.size === 0) {
      show(this.element, h("p", { class: "fine" }, "No sequence was fitted with this rig, and no scene was played."));
      return;
    }
    show(this.#pick, [...this.#jobs.values()].map(({ job }) => (
      h("option", { value: job.id }, `${job.result.summary?.performance ?? plain(job.kind)}, ${when(job.finished_at)}`)
    )));
    show(this.element,
      h("div", { class: "row" }, this.#pick, this.#play),
      h("div", { class: "scrubber" }, this.#scrub, this.#place),
      this.#pulls.element,
      this.#lanes.element,
      this.#about);
    this.#tell();
  }

  /** Return the take of a job, read when it is first asked for; null if there is none. */
  async load(job) {
    const known = this.#jobs.get(job);
    if (!known) return null;
    if (!this.#takes.has(job)) {
      const read = ({ id }) => api.bytes(`/v1/artifacts/${id}`, { signal: this.#signal });
      const beside = [MARKERS, CONTRACTIONS].map((file) => known.job.result.artifacts.find(({ name }) => name === file));
      const files = [known.artifact, ...beside].map((each) => each && read(each));
      this.#takes.set(job, Promise.all(files).then(([skin, markers, contractions]) => (
        new Take(skin, {
          times: framesOf(known),
          markers: markers ? new MarkerTake(markers) : null,
          contractions: contractions ? new Contractions(contractions) : null,
        }))));
    }
    try {
      const take = await this.#takes.get(job);
      if (take.fits(this.#count)) return take;
      this.#fail("this sequence has another topology than the rig");
    } catch (error) {
      this.#takes.delete(job);
      if (!this.#signal.aborted) this.#fail(sentence(error));
    }
    return null;
  }

  /** Show a state and the take that it names. */
  show(state, take) {
    if (!state.take || !take) {
      this.stop();
      return;
    }
    this.#shown = state.take.job;
    this.#pick.value = state.take.job;
    this.#tell(take);
    this.#scrub.max = take.frames - 1;
    this.#lanes.element.hidden = !take.markers;
    if (take.markers) this.#lanes.show(take.markers, state.take.frame);
    this.#pulls.element.hidden = !take.contractions;
    if (take.contractions) this.#pulls.show(take, state.take.frame);
    if (Number(this.#scrub.value) !== state.take.frame) this.#scrub.value = state.take.frame;
    setText(this.#place, `${state.take.frame + 1} of ${take.frames}, ${take.times[state.take.frame].toFixed(2)} s`);
  }

  /** Tell how far what is played is off what was solved, as the job measured it in the file. */
  #tell(take = null) {
    const { job, artifact } = this.#jobs.get(this.#pick.value) ?? {};
    setText(this.#about, artifact?.name === ANIMATION ? ofAnimation(job, take) : ofSequence(job));
  }

  /** Stop playing. */
  stop() {
    cancelAnimationFrame(this.#playing);
    this.#playing = 0;
    this.#play.textContent = "Play";
  }

  #go(job, frame) {
    const first = job ?? this.#pick.value;
    this.#change({ take: { job: first, frame }, expressions: new Map(), controls: new Map(), live: null });
  }

  async #toggle() {
    if (this.#playing) {
      this.stop();
      return;
    }
    const job = this.#pick.value;
    const take = await this.load(job);
    if (!take) return;
    this.#play.textContent = "Pause";
    const first = this.#shown === job ? Number(this.#scrub.value) : 0;
    const from = take.times[first] >= take.times.at(-1) ? take.times[0] : take.times[first];
    let begun = null;
    const step = (now) => {
      begun ??= now;
      const time = from + (now - begun) / 1000;
      this.#go(job, Math.round(take.frameAt(time)));
      if (time >= take.times.at(-1)) this.stop();
      else this.#playing = requestAnimationFrame(step);
    };
    this.#playing = requestAnimationFrame(step);
  }

  #fail(text) {
    show(this.element, h("p", { class: "notice bad", role: "alert" }, text));
  }
}

/** Return the times of an animation's frames in s; null of a sequence, whose file has each. */
function framesOf({ job, artifact }) {
  if (artifact.name === SEQUENCE) return null;
  const { frames, duration } = job.result.summary;
  return Float32Array.from({ length: frames }, (_, frame) => (frames > 1 ? (frame * duration) / (frames - 1) : 0));
}

function ofSequence(job) {
  const written = job?.result.summary?.files?.[SEQUENCE];
  const off = written ? `, ${atMost(written.max_mm, written.frame)}` : "";
  return `The skin of the fit${off}, in the head's own frame; the muscles' sliders follow. Muscles and bones stay at rest in the picture. Arrows go from the fit to where markers were seen, five times as long.`;
}

function ofAnimation(job, take) {
  const written = job.result.summary?.glb;
  const off = written ? `, ${atMost(written.max_error_mm, written.frame)}` : "";
  const where = take?.isCarried ? "as its neck carries it" : "in the head's own frame";
  return `The skin of the simulation${off}, ${take ? where : "as a neck carries it if it has one"}. Muscles and bones stay at rest in the picture; objects are not drawn.`;
}

function atMost(mm, frame) {
  return `at most ${mm.toFixed(2)} mm off it (frame ${frame})`;
}
