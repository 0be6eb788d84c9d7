// The live view beside the face: sessions of the rig, what they do now, recording, and takes.

import * as api from "../../api.js";
import { announce, h, setText, show } from "../../dom.js";
import { meter } from "../../parts/meter.js";
import { FINAL, state as stateOf } from "../../parts/state.js";
import { doing, toast } from "../../parts/toast.js";
import { sentence } from "../../parts/trouble.js";
import { repeat } from "../../repeat.js";
import { plain, when } from "../../words.js";
import { LiveFeed } from "./feed.js";
import { LiveFigures } from "./figures.js";
import { LiveLanes } from "./lanes.js";
import { LiveSkin } from "./skin.js";
import { LiveTakes } from "./takes.js";

const EVERY_MS = 3_000;
const FIGURES_MS = 500;
const TRIES = 20; // to read what the face is drawn by
const AGAIN_MS = 1000;

/**
 * Sessions of a rig. `change(patch)` takes a part of a state, which names the session; `came()` is
 * called where the face has moved, to be shown by `pose` at the next drawing.
 */
export class LivePanel {
  #rig;
  #change;
  #came;
  #signal;
  #feed = null;
  #shown = null;
  #skin = null;
  #frame = null;
  #isDrawing = false;
  #isNewer = false;
  #wasPreparing = false;
  #figures = new LiveFigures();
  #lanes = null;
  #isRecording = false;
  #pick = h("select", { "aria-label": "Session", onchange: () => this.#watch(this.#pick.value || null) });
  #state = stateOf("queued", "Not watched");
  #bar = meter({ attempts: [] });
  #what = h("div", { class: "stack" });
  #facts = new Map();
  #numbers;
  #name = h("input", { type: "text", value: "1", maxlength: 64, "aria-label": "Name of the take", spellcheck: "false" });
  #button = h("button", { type: "button", class: "main", disabled: true, onclick: () => this.#record() }, "Record");
  #takes;
  #pulls = h("div");
  #sessions = new Map();

  constructor(rig, change, came, signal) {
    this.#rig = rig;
    this.#change = change;
    this.#came = came;
    this.#signal = signal;
    this.#takes = new LiveTakes(rig, signal);
    this.#numbers = h("dl", { class: "rig-facts live-facts", hidden: true });
    this.element = h("div", { class: "pose" },
      h("div", { class: "row" }, this.#pick, this.#state),
      this.#what,
      this.#numbers,
      h("div", { class: "row" }, this.#name, this.#button),
      this.#pulls,
      this.#takes.element);
    for (const [name, title] of FACTS) {
      const value = h("dd", {}, "–");
      this.#facts.set(name, value);
      this.#numbers.append(h("div", {}, h("dt", {}, title), value));
    }
  }

  /** Look for sessions now and then, and for takes. */
  async find() {
    this.#takes.find();
    try {
      await repeat(() => this.#look(), EVERY_MS, this.#signal);
    } catch (error) {
      if (!this.#signal.aborted) show(this.#what, h("p", { class: "notice bad", role: "alert" }, sentence(error)));
      return;
    }
    this.#tick();
  }

  /** Whether there is a face of the session to be shown. */
  get hasFace() {
    return this.#frame !== null && (this.#skin !== null || this.#frame.skin !== null);
  }

  /** Set `out` to the places of the face as it is now, over the neutral. */
  pose(out, neutral) {
    this.#rest();
    this.#figures.drawn();
    if (this.#skin) this.#skin.pose(out, neutral, this.#frame);
    else out.set(this.#frame.skin);
  }

  /** Show a state: watch the session that it names, and no other. */
  show({ live }) {
    if (live === this.#shown) return;
    this.#leave();
    this.#shown = live;
    this.#pick.value = this.#sessions.has(live) ? live : "";
    if (live) this.#join(live);
  }

  #watch(id) {
    this.#change({ live: id, take: null, expressions: new Map(), controls: new Map() });
  }

  async #look() {
    const sessions = (await api.all("/v1/live", { rig_id: this.#rig.id }, this.#signal))
      .filter(({ state }) => !FINAL.has(state));
    const known = [...this.#sessions.keys()].join() === sessions.map(({ id }) => id).join();
    this.#sessions = new Map(sessions.map((session) => [session.id, session]));
    if (known && this.#pick.childElementCount) return;
    show(this.#pick,
      h("option", { value: "" }, sessions.length ? "No session" : "No session is running"),
      sessions.map((session) => h("option", { value: session.id }, `${plain(session.source)}, ${when(session.created_at)}`)));
    this.#pick.value = this.#sessions.has(this.#shown) ? this.#shown : "";
    if (!this.#shown && !sessions.length) this.#explain();
  }

  #explain() {
    show(this.#what, h("p", { class: "fine" }, "A session begins at a station: ",
      h("code", {}, `myoface live ${this.#rig.id.slice(0, 8)} --live-link 11111`),
      ", with the app Live Link Face sending to that port."));
  }

  #join(id) {
    this.#state.set("queued", "Joining");
    show(this.#what);
    const feed = new LiveFeed(id, this.#signal);
    this.#feed = feed;
    feed.addEventListener("message", ({ detail }) => this.#hear(id, detail));
    feed.addEventListener("frame", ({ detail }) => this.#take(detail));
    feed.addEventListener("line", ({ detail }) => {
      if (feed.isOver) return;
      if (!detail) this.#state.set("warning", "Line broken");
      else if (this.#lanes) this.#state.set("running", "Live");
      this.#button.disabled = !detail || !this.#lanes;
    });
    feed.addEventListener("failed", ({ detail }) => {
      this.#state.set("failed", "Not watched");
      show(this.#what, h("p", { class: "notice bad", role: "alert" }, sentence(detail)));
    });
    feed.open();
  }

  #leave() {
    this.#feed?.close();
    this.#feed = this.#skin = this.#frame = this.#lanes = null;
    this.#isDrawing = this.#isNewer = this.#wasPreparing = false;
    this.#figures = new LiveFigures();
    this.#setRecording(false);
    this.#button.disabled = true;
    show(this.#pulls);
    this.#state.set("queued", "Not watched");
  }

  #hear(id, said) {
    const { type } = said;
    if (type === "preparing") {
      this.#wasPreparing = true;
      this.#state.set("running", "Preparing");
      this.#bar.set({ attempts: [], progress: { phase: said.phase, fraction: said.fraction } });
      show(this.#what, this.#bar);
    } else if (type === "ready") this.#begin(id, said);
    else if (type === "recording") this.#setRecording(true, said.name);
    else if (type === "take") {
      this.#setRecording(false);
      if (!said.file) toast("No frame came while it recorded: there is no take.", "bad");
      else this.#keep(id, said);
    } else if (type === "fault") toast(`${plain(said.message)}.`, "bad");
    else if (type === "ended") this.#end(said.reason);
  }

  #keep(id, take) {
    this.#takes.add(id, take);
    this.#name.value = next(take.name);
    announce(`Take ${take.name} is recorded`);
  }

  async #begin(id, ready) {
    this.#lanes = new LiveLanes(ready.muscles);
    show(this.#pulls, this.#lanes.element);
    show(this.#what);
    this.#state.set("running", "Live");
    this.#button.disabled = false;
    if (ready.layout.some(({ name }) => name === "skin")) return;
    try {
      const skin = await this.#readSkin(id);
      if (this.#shown !== id) return;
      this.#skin = skin;
      if (this.hasFace) this.#draw();
    } catch (error) {
      if (!this.#signal.aborted) show(this.#what, h("p", { class: "notice bad", role: "alert" }, sentence(error)));
    }
  }

  /** Read the shapes of a session's skin, which are there a moment after it is ready. */
  async #readSkin(id) {
    for (let left = TRIES; ; left--) {
      if (this.#wasPreparing || left < TRIES) await api.pause(AGAIN_MS, this.#signal);
      try {
        return new LiveSkin(await api.bytes(`/v1/live/${id}/view`, { signal: this.#signal }));
      } catch (error) {
        if (error.code !== "artifact.unknown" || !left) throw error;
      }
    }
  }

  #take(frame) {
    frame.skin = this.#skin ? null : frame.array("skin");
    this.#frame = frame;
    this.#figures.came(frame);
    this.#lanes?.add(frame.array("contractions"), frame.isHeld, performance.now() / 1000);
    if (this.hasFace) this.#draw();
  }

  /** Have the newest face drawn, unless it is too soon. */
  #draw() {
    this.#isNewer = this.#isDrawing;
    if (this.#isDrawing) return;
    this.#isDrawing = true;
    this.#came();
  }

  /** Leave the page as long for other things as a drawing takes: a slow machine would do nothing else. */
  #rest() {
    const begun = performance.now();
    setTimeout(() => setTimeout(() => {
      this.#isDrawing = false;
      if (this.#isNewer) this.#draw();
    }, performance.now() - begun));
  }

  #end(reason) {
    this.#state.set("succeeded", "Ended");
    show(this.#what, h("p", { class: "fine" }, `The session has ended: ${reason}.`));
    this.#setRecording(false);
    this.#button.disabled = true;
    announce("The session has ended");
    api.pause(EVERY_MS, this.#signal).then(() => this.#takes.find(), () => {});
  }

  /** Begin or end a take; the session says when it has. */
  async #record() {
    const path = `/v1/live/${this.#shown}/recording`;
    const name = this.#name.value.trim().replace(/\s+/g, "_");
    if (!this.#isRecording && !name) {
      this.#name.focus();
      return;
    }
    await doing(this.#button, () => (
      this.#isRecording ? api.remove(path, this.#signal) : api.put(path, { name }, this.#signal)
    ));
  }

  #setRecording(isRecording, name = "") {
    this.#isRecording = isRecording;
    if (name) this.#name.value = name;
    this.#name.disabled = isRecording;
    setText(this.#button, isRecording ? "Stop" : "Record");
    this.#button.classList.toggle("danger", isRecording);
  }

  /** Show the figures, now and then. */
  #tick() {
    if (this.#signal.aborted) return;
    setTimeout(() => this.#tick(), FIGURES_MS);
    this.#numbers.hidden = !this.#frame || this.#feed.isOver;
    if (this.#numbers.hidden) return;
    const now = this.#figures.now();
    const { error, dropped, isHeld } = this.#frame;
    const words = {
      sent: `${rate(now.sent)} frames a second`,
      followed: `${rate(now.followed)} faces a second, ${rate(now.drawn)} drawn`,
      latency: `${number(now.p50, 1)} ms, 95 % within ${number(now.p95, 1)}`,
      way: `${number(now.way.p50, 1)} ms, 95 % within ${number(now.way.p95, 1)}`,
      error: Number.isFinite(error.p50) ? `${number(error.p50, 2)} mm, 95 % within ${number(error.p95, 2)}` : "not measured yet",
      dropped: String(dropped),
      held: isHeld ? "held: the last frame told nothing" : "follows",
    };
    for (const [name, text] of Object.entries(words)) setText(this.#facts.get(name), text);
    this.#facts.get("held").parentElement.toggleAttribute("data-held", isHeld);
  }
}

const FACTS = [
  ["sent", "in"],
  ["followed", "out"],
  ["latency", "followed within"],
  ["way", "here after, at least"],
  ["error", "off a full solve"],
  ["dropped", "frames dropped"],
  ["held", "face"],
];

function rate(value) {
  return Number.isFinite(value) ? value.toFixed(value < 10 ? 1 : 0) : "–";
}

function number(value, digits) {
  return Number.isFinite(value) ? value.toFixed(digits) : "–";
}

/** Return the name of the take after one: "walk_2" after "walk_1". */
function next(name) {
  const found = /^(.*?)(\d+)$/.exec(name);
  return found ? `${found[1]}${Number(found[2]) + 1}` : `${name}_2`;
}
