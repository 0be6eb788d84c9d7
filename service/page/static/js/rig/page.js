// The rig view: what its controls ask for is one state, and everything shows that state.

import * as api from "../api.js";
import { h } from "../dom.js";
import { sentence } from "../parts/trouble.js";
import { plain } from "../words.js";
import { blend, millimetres } from "./face.js";
import { Figure } from "./figure.js";
import { copyAddress, save } from "./hand_out.js";
import { onClick, onKeys } from "./hands.js";
import { Legend } from "./heat.js";
import { Inside } from "./inside.js";
import { LivePanel } from "./live/panel.js";
import { LookBar } from "./look_bar.js";
import { MarkerSolids, STATES } from "./marker_solids.js";
import { MissingPreview } from "./missing_preview.js";
import { MusclePanel } from "./muscle_panel.js";
import { ExpressionPanel, pose } from "./pose_panel.js";
import { Preview } from "./preview.js";
import { rigAndSubject } from "./read.js";
import { StageBox } from "./stage_box.js";
import { summary } from "./summary.js";
import { tabs } from "./tabs.js";
import { TakePanel } from "./take_panel.js";

const SETTLED_MS = 250;
const SAID_MS = 4000;
const ARROWS = 5; // how much longer than the distances they show
const INSIDE = "inside.bin";
const PREVIEW = "preview.bin";
const DISTANCE = ["distance", "Distance to the scan", 2];
const MOTION = ["motion", "Way from the neutral", 10];

/** The view of a rig; `change` is fired when its state, and so its address, has settled. */
export class RigPage extends EventTarget {
  #rig;
  #face;
  #signal;
  #figure;
  #box = new StageBox("The face");
  #legend = new Legend((low, high) => this.change({ heat: { ...this.state.heat, low, high } }));
  #panels;
  #muscles;
  #takes;
  #live;
  #asked = new Set();
  #preview = null;
  #inside = null;
  #take = null;
  #solids = null;
  #heat = null;
  #isStale = true;
  #settling = 0;

  constructor(rig, face, state, signal) {
    super();
    this.#rig = rig;
    this.#face = face;
    this.#signal = signal;
    this.state = possible(state, face, this.#has(INSIDE));
    this.#figure = new Figure(this.#box.stage, face);
    const change = (patch) => this.change(patch);
    const look = new LookBar({
      heats: heatsOf(face),
      hasScans: face.hasScans,
      hasInside: this.#has(INSIDE),
      box: this.#figure.box,
      change,
    });
    const expressions = new ExpressionPanel({
      rows: face.expressions.map(({ name, mean_mm: mean, p95_mm: p95, max_mm: most }) => (
        { name, figures: [mean, p95, most].map(millimetres) }
      )),
      heads: ["mean", "p95", "most"],
      explained: "Distance to the scan in mm: mean, 95th percentile, most",
      change,
    });
    this.#muscles = new MusclePanel(face, change);
    this.#takes = new TakePanel(face.count, change, signal);
    this.#live = new LivePanel(rig, change, () => this.#moved(), signal);
    this.#panels = [look, expressions, this.#muscles, this.#takes, this.#live];
    const poses = tabs("What the face does", [
      { name: "expressions", title: "Expressions", element: expressions.element },
      { name: "muscles", title: "Muscles", element: this.#muscles.element },
      { name: "takes", title: "Sequences", element: this.#takes.element },
      { name: "live", title: "Live", element: this.#live.element },
    ]);
    if (this.state.controls.size) poses.open("muscles");
    if (this.state.take) poses.open("takes");
    if (this.state.live) poses.open("live");
    this.#box.overlay(this.#legend.element);
    this.element = h("div", { class: "rig" },
      look.element,
      this.#box.element,
      h("section", { class: "panel rig-poses", "aria-label": "What the face does" }, poses.element));
  }

  /** Buttons that hand out what is shown. */
  get buttons() {
    return [
      h("button", { type: "button", onclick: () => this.#savePicture() }, "Save picture"),
      h("button", { type: "button", onclick: () => this.#copyLink() }, "Copy link"),
    ];
  }

  /** Show the face, in the document now; then read what is not needed for that. */
  start() {
    const { stage } = this.#box;
    this.#box.start(this.#figure.box, this.state.view);
    stage.addEventListener("draw", () => this.#isStale && this.#pose());
    stage.addEventListener("look", () => this.#looked());
    onKeys(stage, (number) => this.#showExpression(number));
    onClick(stage, (event) => this.#pick(event));
    // a control that is let go of is kept at once: the next thing may be a reload
    this.element.addEventListener("change", () => this.#settle());
    this.#update();
    stage.finish();
    this.#figure.shade(this.#signal).catch((error) => this.#fail(error));
    this.#findPreview().catch((error) => this.#fail(error));
    this.#takes.find(this.#rig).then(() => this.#update());
    this.#live.find();
  }

  /** Take a part of a state, or what a function makes of the state. */
  change(patch) {
    const given = typeof patch === "function" ? patch(this.state) : patch;
    this.state = { ...this.state, ...given };
    if (given.view) this.#box.stage.look(given.view);
    this.#update();
  }

  dispose() {
    clearTimeout(this.#settling);
    this.#box.dispose();
  }

  /** Show the state; what it needs and is not there yet is read, and then shown. */
  #update() {
    const { state } = this;
    if ((state.inside || state.section) && this.#has(INSIDE)) {
      this.#read(INSIDE, (buffer) => { this.#inside = new Inside(buffer); });
    }
    if (state.take && state.take.job !== this.#take?.job) this.#readTake(state.take.job);
    for (const panel of this.#panels) panel.show(state, this.#shownTake);
    this.#moved();
    this.#settleSoon();
  }

  /** Have the face drawn anew before the next frame of the screen. */
  #moved() {
    this.#isStale = true;
    this.#box.stage.invalidate();
  }

  /** Bring what is drawn up to the state. */
  #pose() {
    this.#isStale = false;
    const { state } = this;
    const { neutral, names } = this.#face;
    const { places } = this.#figure;
    const weights = names.map((name) => state.expressions.get(name) ?? 0);
    if (state.live && this.#live.hasFace) this.#live.pose(places, neutral);
    else if (this.#shownTake) this.#shownTake.pose(places, state.take.frame);
    else if (state.controls.size && this.#preview) {
      const values = this.#preview.controls.map(({ name }) => state.controls.get(name) ?? 0);
      blend(places, neutral, this.#preview.weights(values), (r) => this.#preview.shape(r));
    } else blend(places, neutral, weights, (k) => this.#face.skin(k));
    this.#showMarkers(this.#shownTake?.markers);
    this.#showScan(weights);
    if (this.#inside) {
      this.#inside.setWeights(weights);
      this.#inside.choose(this.#face.meant(state.muscle));
      this.#figure.showInside(this.#inside, state.inside, state.section);
    }
    this.#showHeat(weights);
    this.#figure.moved();
    this.#box.name(state.inside && state.muscle ? plain(state.muscle) : "");
    // for scripts of the person's own, and for tests
    this.element.dispatchEvent(new CustomEvent("posed", { detail: { places } }));
  }

  /** Show the markers of a take (`MarkerTake`), and by arrows how far off the fit they were seen. */
  #showMarkers(markers) {
    if (this.#solids) this.#solids.group.visible = Boolean(markers);
    if (!markers) return;
    if (this.#solids?.of !== markers) {
      this.#solids?.group.removeFromParent();
      this.#solids = new MarkerSolids(markers.labels.length);
      this.#solids.of = markers;
      this.#box.stage.panes[0].add(this.#solids.group);
    }
    const { frame } = this.state.take;
    const colours = markers.labels.map((_, k) => STATES[markers.state(frame, k)].colour);
    this.#solids.set(markers.places(frame), markers.off(frame), colours, { times: ARROWS });
  }

  /** Show the scan of the same blend of expressions; there is none of muscles and frames. */
  #showScan(weights) {
    const { scan, controls, take, live } = this.state;
    const { neutral } = this.#face;
    const isThere = scan && !controls.size && !take && !live;
    this.#box.setPanes(isThere && scan === "beside" ? ["Fit", "Scan"] : [""]);
    this.#figure.setScan(scan, isThere
      ? blend(new Float32Array(neutral.length), neutral, weights, (k) => this.#face.scan(k)) : null);
  }

  #showHeat(weights) {
    const { heat } = this.state;
    this.#heat = heat && this.#heatOf(heat.of, weights);
    this.#figure.skin.setHeat(this.#heat?.values ?? null);
    if (this.#heat) {
      this.#figure.skin.setRange(heat.low, heat.high);
      this.#legend.show(this.#heat.title, heat.low, heat.high, this.#heat.values.some(Number.isNaN));
    } else this.#legend.hide();
  }

  /** Return title and values per vertex of a heat map. Of a blend, the strongest expression's counts. */
  #heatOf(of, weights) {
    if (of === "motion" || !this.#face.hasScans) return { title: MOTION[1], values: this.#figure.motion() };
    if (this.state.expressions.size) {
      const strongest = weights.indexOf(Math.max(...weights));
      return { title: `${DISTANCE[1]}, ${plain(this.#face.names[strongest])}`, values: this.#face.error(strongest) };
    }
    return { title: "Greatest distance to the scan of any expression", values: this.#face.worst() };
  }

  #looked() {
    this.state.view = this.#box.stage.view;
    this.#figure.faceCamera();
    this.#panels[0].show(this.state);
    this.#settleSoon();
  }

  #settleSoon() {
    clearTimeout(this.#settling);
    this.#settling = setTimeout(() => this.#settle(), SETTLED_MS);
  }

  /** Say and keep what is shown, once the controls rest. */
  #settle() {
    if (this.#isStale) this.#box.stage.draw(); // what is said is what is drawn
    this.#box.describe(summary(this.state, { heats: this.#heat ? [this.#heat] : [], take: this.#shownTake }));
    this.dispatchEvent(new Event("change"));
  }

  get #shownTake() {
    return this.state.take && this.#take?.job === this.state.take.job ? this.#take.take : null;
  }

  #showExpression(number) {
    const name = this.#face.names[number - 1];
    if (number === 0 || name) this.change(pose(name ? new Map([[name, 1]]) : new Map()));
  }

  #pick(event) {
    const found = this.#figure.pick(event);
    if (!found) return;
    if (found.isMuscle) this.change({ muscle: this.state.muscle === found.name ? null : found.name });
    else this.#box.name(plain(found.name));
  }

  /** Read the sliders' file; without one, say how there can be one, and wait for it. */
  async #findPreview() {
    if (this.#has(PREVIEW)) await this.#readPreview();
    else {
      const missing = new MissingPreview(this.#rig, () => this.#lookAgain(), this.#signal);
      this.#muscles.setMissing(missing.element);
      await missing.find();
    }
    this.#update();
  }

  async #readPreview() {
    await this.#read(PREVIEW, (buffer) => {
      this.#preview = new Preview(buffer);
      this.#muscles.setPreview(this.#preview);
      const names = this.#preview.controls.map(({ name }) => name);
      this.state = { ...this.state, controls: among(this.#ofParts(this.state.controls), names) };
    });
  }

  /** Read the sliders of a rig that has got some since it was opened; returns whether it has. */
  async #lookAgain() {
    [this.#rig] = await rigAndSubject(this.#rig.id, this.#signal);
    if (this.#has(PREVIEW)) await this.#readPreview();
    return this.#has(PREVIEW);
  }

  /** Return values with those of whole muscles given to their compartments. */
  #ofParts(values) {
    return new Map([...values].flatMap(([name, value]) => {
      const meant = this.#face.meant(name);
      return (meant.length ? meant : [name]).map((each) => [each, value]);
    }));
  }

  async #readTake(job) {
    const take = await this.#takes.load(job);
    if (!take || this.#take?.job === job || this.state.take?.job !== job) return;
    this.#take = { job, take };
    const frame = Math.min(this.state.take.frame, take.frames - 1);
    this.change({ take: { job, frame } });
  }

  #has(name) {
    return this.#rig.artifacts.some((artifact) => artifact.name === name);
  }

  /** Read a file of the rig, once; `ready` gets it, and the state is shown anew. */
  async #read(name, ready) {
    if (this.#asked.has(name)) return;
    this.#asked.add(name);
    const path = `/v1/rigs/${this.#rig.id}/artifacts/${name}`;
    const progress = (received, total) => (
      this.#box.say(total ? `Loading … ${Math.round((100 * received) / total)} %` : "Loading …")
    );
    try {
      ready(await api.bytes(path, { signal: this.#signal, progress }));
      this.#box.say("");
      this.#update();
    } catch (error) {
      this.#asked.delete(name);
      this.#fail(error);
    }
  }

  async #savePicture() {
    const { expressions } = this.state;
    const [name = "neutral"] = [...expressions.keys()];
    save(await this.#box.stage.picture(), `rig-${this.#rig.id.slice(0, 8)}-${name}.png`);
  }

  async #copyLink() {
    this.#settle();
    this.#box.say(await copyAddress());
    setTimeout(() => this.#box.say(""), SAID_MS);
  }

  #fail(error) {
    if (!this.#signal.aborted) this.#box.say(sentence(error));
  }
}

function heatsOf(face) {
  return face.hasScans ? [DISTANCE, MOTION] : [MOTION];
}

/** Return what of a state, as an address may ask for it, this rig can show. */
function possible(state, face, hasInside) {
  return {
    ...state,
    expressions: among(state.expressions, face.names),
    heat: heatsOf(face).some(([of]) => of === state.heat?.of) ? state.heat : null,
    scan: face.hasScans ? state.scan : null,
    inside: hasInside && state.inside,
    muscle: face.meant(state.muscle).length ? state.muscle : null,
    section: hasInside ? state.section : null,
  };
}

function among(values, names) {
  return new Map([...values].filter(([name]) => names.includes(name)));
}
