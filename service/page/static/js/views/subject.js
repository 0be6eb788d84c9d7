// One person: scans with their verdicts, the model, rigs; and the work that can be asked for.

import { all, get, remove } from "../api.js";
import { h, setText, show } from "../dom.js";
import { keyed } from "../keyed.js";
import { changed, kindsByName, rolesByName } from "../library.js";
import { askToDeleteSubject } from "../parts/delete_subject.js";
import { ask } from "../parts/dialog.js";
import { askToEditCapture, askToEditRig, askToEditSubject } from "../parts/edit.js";
import { panel, table } from "../parts/frame.js";
import { verdictOf } from "../parts/certificate.js";
import { askForJob } from "../parts/new_job.js";
import { toldBeforeDeletion } from "../parts/readers.js";
import { refuse } from "../parts/refuse.js";
import { kindsOfEstimates, kindsOfFits, kindsOfPhotos, kindsOfRigs, whyNoPhotos } from "../parts/rig_kinds.js";
import { state, verdictState } from "../parts/state.js";
import { doing, toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { repeat } from "../repeat.js";
import { isMarkerSet } from "../scan_files.js";
import { navigate, title as nameWindow } from "../navigate.js";
import { bytes, count, figure, labelWords, plain, short, when } from "../words.js";

const EVERY_MS = 5_000;

/** Roles of captures that are chosen for fits: scans, a table of known activations beside them, photographs. */
const CHOSEN_FOR_FITS = ["expression", "activations", "photo"];

/** How many photographs a job reads at most; more of them are a film. */
const MOST_PHOTOS = 16;

/** What the state of the newest build says of the model. */
const MODEL = { succeeded: "Built", queued: "Waits to be built", running: "Being built", failed: "Not built" };

export async function mount(root, { id }) {
  const ending = new AbortController();
  const [subject, kinds, roles] = await Promise.all([
    get(`/v1/subjects/${id}`, {}, ending.signal),
    kindsByName(),
    rolesByName(),
  ]);
  nameWindow(subject.name);
  const view = new SubjectView(subject, kinds, roles, ending.signal);
  root.append(...view.elements);
  await repeat(
    () => view.refresh(),
    EVERY_MS,
    ending.signal,
    (error) => toast(sentence(error), "bad"),
  );
  return () => ending.abort();
}

class SubjectView {
  constructor(subject, kinds, roles, signal) {
    this.subject = subject;
    this.kindsOfRigs = kindsOfRigs(kinds);
    this.kindsOfFits = kindsOfFits(kinds);
    this.kindsOfPhotos = kindsOfPhotos(kinds);
    this.fitsOfModel = this.kindsOfPhotos.map(({ kind, title }) => button(title, () => this.fitPhotos(kind)));
    this.estimates = kindsOfEstimates(kinds).map(({ kind, title }) =>
      button(title, () => this.order(kind, { captures: this.chosenOf("photo") })),
    );
    this.roles = roles;
    this.signal = signal;
    this.chosen = new Set();
    this.captureBody = h("tbody");
    this.showCaptures = keyed(this.captureBody, ({ capture }) => this.captureRow(capture));
    this.rigBody = h("tbody");
    this.showRigs = keyed(this.rigBody, (rig) => this.rigRow(rig));
    this.model = h("p");
    this.build = button("Build the model", () => this.order("build_model"));
    this.tracks = button("Build tracks", () =>
      this.order("build_tracks", { captures: this.chosenOf("expression") }),
    );
    this.fit = button("Fit the chosen expressions", () =>
      this.order("fit_geometry", { captures: this.chosenOf("expression", "activations") }),
    );
    this.noScans = h("p", { class: "empty", hidden: true }, "No scans yet.");
    this.noRigs = h(
      "p",
      { class: "empty", hidden: true },
      "No rigs yet. Build the model, choose expressions above and fit them.",
    );
    this.next = h("p", { class: "fine", hidden: true });
    this.captureTable = table(
      ["(Choose)", "Scan", "Role", "Form", "Check", "Registration", "Added", "(Actions)"],
      this.captureBody,
    );
    const columns = ["Rig", "Verdict", "Expressions", "Mean error", "Made", "(Actions)"];
    this.rigTable = table(columns, this.rigBody, { class: "rigs" });
    this.name = h("h1");
    this.about = h("p", { class: "fine grow" });
    this.showSubject();
    this.elements = [
      h(
        "div",
        { class: "head" },
        this.name,
        this.about,
        button("Edit", () => this.editSubject()),
        h("a", { class: "button", href: `/?subject_id=${subject.id}` }, "Jobs"),
        h("a", { class: "button", href: `/upload?subject=${subject.id}` }, "Upload scans"),
        h("button", { type: "button", class: "danger", onclick: () => this.delete() }, "Delete subject"),
      ),
      panel("scans", "Scans", this.captureTable, this.noScans, this.next),
      panel("model", "Model", h("div", { class: "stack" }, this.model, h("div", { class: "row" }, this.estimates, this.build, this.tracks, this.fit, this.fitsOfModel))),
      panel("rigs", "Rigs", this.rigTable, this.noRigs),
    ];
  }

  async refresh() {
    const of = { subject_id: this.subject.id };
    const [captures, rigs, models, checks, proposals, markerChecks, tracks] = await Promise.all([
      all(`/v1/subjects/${this.subject.id}/captures`, {}, this.signal),
      all("/v1/rigs", of, this.signal),
      get("/v1/jobs", { ...of, kind: "build_model", limit: 1 }, this.signal),
      get("/v1/jobs", { ...of, kind: "check_scan", limit: 200 }, this.signal),
      get("/v1/jobs", { ...of, kind: "next_scan", state: "succeeded", limit: 1 }, this.signal),
      get("/v1/jobs", { ...of, kind: "check_markers", limit: 200 }, this.signal),
      get("/v1/jobs", { ...of, has: "tracks.npz", limit: 1 }, this.signal),
    ]);
    // newest first, so the last one written is the newest
    this.checks = new Map(checks.items.reverse().map((job) => [job.captures[0], job]));
    for (const job of markerChecks.items.reverse()) for (const id of job.captures) this.checks.set(id, job);
    this.sets = captures.filter(isMarkerSet).sort((a, b) => b.created_at.localeCompare(a.created_at));
    captures.sort((a, b) => (b.role === "neutral") - (a.role === "neutral") || a.name.localeCompare(b.name));
    this.rigs = rigs;
    this.hasTracks = tracks.items.length > 0;
    this.assets = captures.filter(({ role }) => role === "asset").map(({ id }) => id);
    this.captures = new Map(captures.map((capture) => [capture.id, capture]));
    this.chosen = new Set([...this.chosen].filter((id) => CHOSEN_FOR_FITS.includes(this.captures.get(id)?.role)));
    // another name or role makes another row: its buttons have both in them
    this.showCaptures(captures.map((capture) => ({ id: [capture.id, capture.name, capture.role].join(), capture })));
    this.showRigs(rigs);
    this.captureTable.hidden = !captures.length;
    this.noScans.hidden = captures.length > 0;
    this.rigTable.hidden = !rigs.length;
    for (const each of [this.noRigs, ...this.fitsOfModel]) each.hidden = rigs.length > 0;
    this.showModel(models.items[0]);
    this.mark();
    await this.showNext(proposals.items[0]);
  }

  showModel(job) {
    const key = job ? `${job.id} ${job.state}` : "none";
    if (this.shownModel === key) return;
    this.shownModel = key;
    show(
      this.model,
      job
        ? [state(job.state, MODEL[job.state]), " ", h("a", { href: `/jobs/${job.id}` }, `by the job of ${when(job.created_at)}`)]
        : "Not built yet.",
    );
  }

  /** Show what to scan next, as the newest proposal for a rig of this person has it. */
  async showNext(job) {
    if (this.shownNext === job?.id) return;
    const { result } = job ? await get(`/v1/jobs/${job.id}`, {}, this.signal) : {};
    this.shownNext = job?.id;
    this.next.hidden = !job;
    if (job) show(this.next, result.summary.words, ". ", link(job.id, "Why"));
  }

  mark() {
    const expressions = this.chosenOf("expression").length;
    const why = expressions ? null : "Choose expressions in the list of scans first";
    refuse(this.fit, why);
    setText(this.fit, expressions ? `Fit ${count(expressions, "expression")}` : "Fit the chosen expressions");
    setText(this.tracks, `Build tracks${expressions ? ` with ${count(expressions, "expression")}` : ""}`);
    for (const more of this.rigBody.querySelectorAll("button[data-more]")) refuse(more, why);
    const photos = [[...this.captures.values()], this.chosenOf("photo")];
    for (const estimate of this.estimates) refuse(estimate, whyNoPhotos(...photos));
    const whyNoFit = whyNoPhotos(...photos, this.hasTracks ? null : "Build tracks first");
    for (const fit of [...this.fitsOfModel, ...this.rigBody.querySelectorAll("button[data-photos]")]) refuse(fit, whyNoFit);
  }

  /** Return the ids of the chosen captures of some roles. */
  chosenOf(...roles) {
    return [...this.chosen].filter((id) => roles.includes(this.captures.get(id).role));
  }

  captureRow(capture) {
    const { id, name, role, filename, size } = capture;
    const about = h("div", { class: "fine" });
    const check = h("td");
    const registration = h("td");
    const box = h("input", {
      type: "checkbox",
      "aria-label": `Choose ${name} for a fit`,
      checked: this.chosen.has(id),
      onchange: () => {
        if (box.checked) this.chosen.add(id);
        else this.chosen.delete(id);
        this.mark();
      },
    });
    const act = (words, action, kind = null) =>
      button([words, h("span", { class: "unseen" }, ` ${name}`)], action, kind);
    const isScan = this.roles.get(role).is_scan;
    const isTake = role === "markers" && !isMarkerSet(capture);
    const actions = h(
      "div",
      { class: "row end" },
      isScan && act("Check", () => this.order("check_scan", { captures: [id] })),
      isScan && !capture.registered && act("Register", () => this.order("register_scan", { captures: [id] })),
      isTake && act("Check", () => this.checkMarkers(id)),
      isTake && act("Fit", () => this.fitTake("fit_markers", [id], { marker_set: this.sets[0]?.id })),
      role === "performance" && act("Fit", () => this.fitTake("fit_sequence", [id])),
      role === "film" && act("Fit", () => this.fitFilm([id])),
      act("Edit", () => this.edit(askToEditCapture(this.captures.get(id)))),
      act("Delete", () => this.deleteCapture(capture), "plain danger"),
    );
    let shown = null;
    return {
      element: h(
        "tr",
        {},
        h("td", { class: "tight" }, CHOSEN_FOR_FITS.includes(role) ? box : null),
        h("th", { scope: "row" }, name, about),
        h("td", {}, this.roles.get(role).title),
        h("td", {}, isScan && (capture.registered ? "Registered" : "Raw"), isTake && "Take", isMarkerSet(capture) && "Marker set", role === "photo" && capture.landmarks && `With ${capture.landmarks}`),
        check,
        registration,
        h("td", { class: "tight" }, when(capture.created_at)),
        h("td", { class: "tight" }, actions),
      ),
      update: ({ capture: next }) => {
        const title = filename.startsWith(`${next.title}.`) ? filename : `${next.title}, ${filename}`;
        setText(about, `${title}, ${bytes(size)}${labelWords(next.labels)}`);
        const job = this.checks.get(id);
        const verdict = isTake && job?.result?.verdict;
        const key = JSON.stringify([next.check, next.registration, job?.state, verdict]);
        if (shown === key) return;
        shown = key;
        show(check, isScan && checkOf(next, job), isTake && checkOf({ check: verdict && { job_id: job.id, verdict } }, job));
        show(registration, !capture.registered && registrationOf(next));
      },
    };
  }

  rigRow(rig) {
    const { mean_mm: error } = rig;
    const name = h("a", { href: `/rigs/${rig.id}` });
    const about = h("div", { class: "fine" });
    return {
      element: h(
        "tr",
        {},
        h("th", { scope: "row", class: "tight" }, name, about),
        h("td", { class: "tight" }, verdictOf(rig) ?? "not judged"),
        h("td", {}, rig.expressions.join(", ")),
        h("td", { class: "tight" }, error === null ? "" : `${figure(error)} mm`),
        h("td", { class: "tight" }, when(rig.created_at)),
        h(
          "td",
          {},
          h(
            "div",
            { class: "row end" },
            h("a", { class: "button", href: `/jobs/${rig.job_id}` }, "Files"),
            button("Edit", () => this.edit(askToEditRig(this.rigs.find(({ id }) => id === rig.id)))),
            this.kindsOfFits.map(({ kind, reads }) =>
              button(
                kind === "fit_activations" ? "Fit more to it" : plain(kind),
                () => {
                  const tables = reads.includes("activations") ? ["activations"] : [];
                  return this.order(kind, { rig_id: rig.id, captures: this.chosenOf("expression", ...tables) });
                },
                null,
                { "data-more": true },
              ),
            ),
            this.kindsOfPhotos.map(({ kind, title }) =>
              button(title, () => this.fitPhotos(kind, rig.id), null, { "data-photos": true }),
            ),
            this.kindsOfRigs.map(({ kind, reads }) =>
              button(plain(kind), () =>
                this.order(kind, { rig_id: rig.id, captures: reads.includes("assets") ? this.assets : [] }),
              ),
            ),
          ),
        ),
      ),
      update: (next) => {
        setText(name, next.name || "Open the rig");
        setText(about, short(next.id) + labelWords(next.labels));
      },
    };
  }

  /** Show what was changed, once it is. */
  async edit(change) {
    if (!(await change)) return;
    changed(this.subject.id);
    await this.refresh();
  }

  async editSubject() {
    const next = await askToEditSubject(this.subject);
    if (!next) return;
    this.subject = next;
    changed(next.id);
    nameWindow(next.name);
    this.showSubject();
  }

  showSubject() {
    const { id, name, labels, created_at: added } = this.subject;
    setText(this.name, name);
    show(this.about, h("code", { title: id }, short(id)), `, added ${when(added)}${labelWords(labels)}`);
  }

  /** Ask for a job about this subject and go to it; a check leaves the operator here. */
  async order(kind, more = {}) {
    const job = await askForJob({ kind, subject_id: this.subject.id, ...more });
    if (!job) return;
    if (["check_scan", "register_scan", "check_markers"].includes(kind)) await this.refresh();
    else navigate(`/jobs/${job.id}`);
  }

  /** Check a take against the newest rig; without one, alone. */
  async checkMarkers(captureId) {
    const rig = this.rigs[0] ? { rig_id: this.rigs[0].id } : {};
    await this.order("check_markers", { ...rig, captures: [captureId] });
  }

  async fitTake(kind, captures, more = {}) {
    if (!this.rigs.length) {
      toast("There is no rig yet to fit it with: build the model and fit expressions first.", "bad");
      return;
    }
    const tables = this.chosenOf("activations");
    await this.order(kind, { rig_id: this.rigs[0].id, captures: [...captures, ...tables], ...more });
  }

  /** Fit chosen photographs with a rig, else with the model; so many are a film, which the options say. */
  async fitPhotos(kind, rigId) {
    const captures = this.chosenOf("photo");
    const options = captures.length > MOST_PHOTOS ? { sequence: true } : {};
    await this.order(kind, { rig_id: rigId, captures, options });
  }

  async fitFilm(captures) {
    if (!this.rigs.length) toast("There is no rig yet to fit it with: build the model and fit expressions first.", "bad");
    else await this.order("fit_photo", { rig_id: this.rigs[0].id, captures, options: { sequence: true } });
  }

  async deleteCapture(capture) {
    const { id, name } = capture;
    const readers = await toldBeforeDeletion(this.captures.get(id) ?? capture);
    const done = await ask({
      title: `Delete the scan ${name}?`,
      body: [
        h("p", {}, "It goes with its landmarks, checks and registrations. Models and rigs made from it stay."),
        readers && h("p", {}, readers),
      ],
      agree: "Delete the scan",
      danger: true,
      act: async () => {
        await remove(`/v1/subjects/${this.subject.id}/captures/${id}`);
        return true;
      },
    });
    if (!done) return;
    changed(this.subject.id);
    await this.refresh();
  }

  async delete() {
    if (!(await askToDeleteSubject(this.subject))) return;
    changed(this.subject.id);
    toast(`${this.subject.name} is deleted. Files go within minutes.`);
    navigate("/subjects");
  }
}

/** The verdict of the newest check, or where it stands. */
function checkOf({ check }, job) {
  if (job && job.state !== "succeeded") return link(job.id, state(job.state));
  return check ? link(check.job_id, verdictState(check.verdict, job?.kind ?? "check_scan")) : "not checked";
}

function registrationOf({ registration }) {
  return registration ? link(registration.job_id, state("succeeded", "Done")) : "not yet";
}

function button(words, action, kind = null, more = {}) {
  const element = h(
    "button",
    { type: "button", class: kind, ...more, onclick: () => doing(element, action) },
    words,
  );
  return element;
}

function link(jobId, ...content) {
  return h("a", { class: "quiet-link", href: `/jobs/${jobId}` }, content);
}
