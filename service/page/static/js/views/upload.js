// Upload: a set of scans is dropped, named, sent and judged.
//
// Uploads go on while other views are shown, so what is shown here lives as long as the page.

import { ApiProblem, get, pause, post } from "../api.js";
import { announce, h, setText, show } from "../dom.js";
import * as interrupted from "../interrupted.js";
import { changed, kindsByName, names, serviceLimits, subjectsById } from "../library.js";
import { table } from "../parts/frame.js";
import { optionFields, readOptions } from "../parts/options.js";
import { refuse } from "../parts/refuse.js";
import { ScanRow } from "../parts/scan_row.js";
import { Session } from "../parts/session.js";
import { toast } from "../parts/toast.js";
import { sentence } from "../parts/trouble.js";
import { beside, countVertices, dropped, sorted } from "../scan_files.js";
import { imagesOf } from "../scan_zip.js";
import { CAN_CHECK } from "../tus.js";
import { count, some } from "../words.js";

const EVERY_MS = 1_000;
const ACTIVE = ["waiting", "sending", "sent", "checking"];
const ALL_STEPS = ["register", "model", "geometry"];

let tray = null;

document.addEventListener("keychange", () => {
  tray = null; // another key may be another studio's
});

export async function mount(root, _params, query) {
  changed(); // others add subjects too
  const [limits, kinds, subjects] = await Promise.all([serviceLimits(), kindsByName(), subjectsById()]);
  tray ??= new Tray(limits, kinds.get("check_scan").options);
  tray.showSubjects(subjects, query.get("subject"));
  root.append(...tray.elements);
  const ending = new AbortController();
  tray.takeDrops(ending.signal);
  return () => ending.abort();
}

class Tray {
  constructor(limits, schema) {
    this.limits = limits;
    this.schema = schema;
    this.rows = [];
    this.sessions = [];
    this.waiting = [];
    this.isSending = false;
    this.subject = h("select", { id: "subject", onchange: () => this.mark() });
    this.newName = h("input", {
      type: "text",
      id: "subject-name",
      maxlength: 200,
      required: true,
      autocomplete: "off",
      placeholder: "Name, session",
    });
    this.newField = h(
      "div",
      { class: "field" },
      h("label", { for: "subject-name" }, "Name of the new subject"),
      this.newName,
    );
    this.form = h(
      "select",
      { id: "form" },
      h("option", { value: "raw" }, "as the scanner made them (raw)"),
      h("option", { value: "registered" }, "in the template's topology (registered)"),
    );
    this.then = h(
      "select",
      { id: "then" },
      h("option", { value: "" }, "only check them"),
      h("option", { value: "all" }, "check them and make a rig of them"),
    );
    this.options = optionFields(schema);
    this.told = h("div", { class: "stack" });
    this.body = h("tbody");
    this.others = h("p", { class: "fine", hidden: true });
    const columns = ["File", "Name", "Role", "State", "Verdict", "(Actions)"];
    this.table = table(columns, this.body, { class: "scans" });
    this.table.hidden = true;
    this.start = h("button", { class: "main" }, "Upload");
    this.go = h("a", { class: "button", hidden: true }, "Go to the subject");
    this.zone = this.dropZone();
    this.settings = h(
      "form",
      { class: "panel stack", onsubmit: (event) => this.submit(event) },
      h(
        "div",
        { class: "row top" },
        h("div", { class: "field" }, h("label", { for: "subject" }, "Subject"), this.subject),
        this.newField,
        h("div", { class: "field" }, h("label", { for: "form" }, "The scans are"), this.form),
        h("div", { class: "field" }, h("label", { for: "then" }, "The service is to"), this.then),
      ),
      h("details", {}, h("summary", {}, "Unit or eye distance, and axes, if the check cannot find them"), this.options),
      this.table,
      this.others,
      h(
        "div",
        { class: "row" },
        this.start,
        this.go,
        !CAN_CHECK &&
          h(
            "p",
            { class: "fine" },
            "This address is not https: pieces are not checked on the way, only their number.",
          ),
      ),
    );
    this.resume = h("div", { class: "notice", hidden: true });
    this.elements = [h("h1", {}, "Upload"), this.resume, this.zone, this.settings, this.told];
    this.tellInterrupted();
    this.showRows();
    addEventListener("beforeunload", (event) => this.isSending && event.preventDefault());
  }

  dropZone() {
    const pick = (attributes) => {
      const input = h("input", {
        type: "file",
        multiple: true,
        class: "unseen",
        tabindex: -1,
        "aria-hidden": "true",
        ...attributes,
        onchange: () => {
          this.take([...input.files]);
          input.value = "";
        },
      });
      return input;
    };
    const files = pick({ id: "files" });
    const folder = pick({ id: "folder", webkitdirectory: true });
    return h(
      "div",
      { class: "zone" },
      h("p", {}, h("strong", {}, "Drop a scan set here"), ": files or a whole folder"),
      h(
        "div",
        { class: "row" },
        h("button", { type: "button", onclick: () => files.click() }, "Choose files"),
        h("button", { type: "button", onclick: () => folder.click() }, "Choose a folder"),
        files,
        folder,
      ),
      h(
        "p",
        { class: "fine" },
        `${this.limits.raw_scan_formats.join(" ")}; landmarks ${this.limits.landmark_formats.join(" ")} beside a scan of the same name; ${otherFiles(this.limits.roles)}`,
      ),
    );
  }

  /** Take what is dropped anywhere in the window, on another view too. */
  takeDrops(signal) {
    document.addEventListener("filesdropped", ({ detail }) => this.take(detail), { signal });
    const over = (isOver) => this.zone.classList.toggle("over", isOver);
    addEventListener(
      "dragover",
      (event) => {
        event.preventDefault();
        over(true);
      },
      { signal },
    );
    addEventListener("dragleave", (event) => event.relatedTarget === null && over(false), { signal });
    addEventListener(
      "drop",
      async (event) => {
        event.preventDefault();
        over(false);
        this.take(await dropped(event.dataTransfer));
      },
      { signal },
    );
  }

  showSubjects(subjects, wanted) {
    const before = this.subject.value;
    show(
      this.subject,
      h("option", { value: "" }, "New subject"),
      [...names(subjects)].map(([id, name]) => h("option", { value: id }, name)),
    );
    const interruptedOne = this.rows.length ? null : interrupted.read().at(-1)?.subjectId;
    this.subject.value = [wanted, before, interruptedOne].find((id) => id && subjects.has(id)) ?? "";
    this.mark();
  }

  mark() {
    this.newField.hidden = this.subject.value !== "";
    this.newName.required = !this.newField.hidden;
  }

  tellInterrupted() {
    const files = interrupted.read().map(({ filename }) => filename);
    this.resume.hidden = !files.length;
    show(
      this.resume,
      h(
        "p",
        {},
        `${count(files.length, "file was", "files were")} on the way when this page was closed: `,
        h("strong", {}, some(files)),
        ". Drop the same files again, and they go on where they stopped.",
      ),
    );
  }

  async take(files) {
    const { scans, others: rest } = sorted(files, this.limits);
    for (const scan of scans) scan.images = await imagesOf(scan.file, beside(scan.file, rest));
    const images = new Set(scans.flatMap((scan) => scan.images));
    const others = rest.filter((file) => !images.has(file));
    for (const scan of scans)
      this.rows.push(
        new ScanRow(scan, this.limits.roles, { dropped: (row) => this.drop(row), again: (row) => this.again(row) }),
      );
    this.others.hidden = !others.length;
    setText(
      this.others,
      `${count(others.length, "file is no scan and stays", "files are no scans and stay")} here: ${some(others.map(({ name }) => name))}`,
    );
    this.resume.hidden = true;
    this.showRows();
    announce(`${count(scans.length, "scan")} added`);
  }

  drop(row) {
    this.rows = this.rows.filter((other) => other !== row);
    this.showRows();
    const session = this.sessions.find((each) => each.has(row));
    if (session?.drop(row)) this.lineUp(session);
  }

  /** Try again what failed together with a row. */
  again(row) {
    const session = this.sessions.find((each) => each.has(row));
    session.again();
    this.lineUp(session);
  }

  showRows() {
    show(
      this.body,
      this.rows.map(({ element }) => element),
    );
    this.table.hidden = !this.rows.length;
    const ready = this.ready();
    refuse(this.start, ready.length ? null : "Choose files or drop them here first");
    setText(this.start, ready.length ? `Upload ${count(ready.length, "scan")}` : "Upload");
  }

  ready() {
    return this.rows.filter(({ stage }) => stage === "ready");
  }

  async submit(event) {
    event.preventDefault();
    const rows = this.ready();
    const twice = repeated(rows.map(({ name }) => name.value));
    if (twice) {
      toast(`Two scans are called ${twice}. Give each a name of its own.`, "bad");
      return;
    }
    if (rows.filter(({ role }) => role.value === "neutral").length > 1) {
      toast("Only one scan can be the neutral.", "bad");
      return;
    }
    this.start.disabled = true;
    try {
      if (this.form.value === "registered") await this.requireVertices(rows);
      const subjectId = this.subject.value || (await this.newSubject());
      const order = {
        registered: this.form.value === "registered",
        options: readOptions(this.schema, this.settings),
        then: this.then.value ? ALL_STEPS : [],
      };
      // the neutral first: what is checked first says soonest whether the set is any good
      rows.sort((a, b) => (b.role.value === "neutral") - (a.role.value === "neutral"));
      const session = new Session(rows, { subjectId, ...order });
      this.sessions.push(session);
      this.told.append(session.element);
      this.go.href = `/subjects/${subjectId}`;
      this.go.hidden = false;
      this.lineUp(session);
    } catch (error) {
      toast(sentence(error), "bad");
    }
    this.showRows();
  }

  /** Refuse scans that are said to be registered and have not the template's count of vertices. */
  async requireVertices(rows) {
    const template = (await subjectsById()).get(this.subject.value)?.template_id;
    const { vertices } = template ? await get(`/v1/templates/${template}`) : { vertices: this.limits.builtin_vertices };
    const scans = rows.filter(({ isScan }) => isScan);
    for (const { file } of vertices ? scans : []) {
      const found = await countVertices(file);
      if (found === null || found === vertices) continue;
      const detail = `${file.name} has ${found} vertices, and a registered scan has the template's ${vertices}. Send it as the scanner made it`;
      throw new ApiProblem({ status: 0, code: "page.topology", detail });
    }
  }

  async newSubject() {
    const { id, name } = await post("/v1/subjects", { name: this.newName.value });
    changed();
    this.subject.append(h("option", { value: id }, name));
    this.subject.value = id;
    this.newName.value = "";
    this.mark();
    return id;
  }

  /** Have a session sent when those before it are. */
  lineUp(session) {
    if (!this.waiting.includes(session)) this.waiting.push(session);
    this.sendAll();
    this.follow();
  }

  /** Send the sessions that wait, one after the other. */
  async sendAll() {
    if (this.isSending) return;
    this.isSending = true;
    const tell = () => tellUploads(this.waiting.reduce((sum, { left }) => sum + left, 0));
    try {
      while (this.waiting.length) await this.waiting[0].run(tell).finally(() => this.waiting.shift());
    } finally {
      this.isSending = false;
      tellUploads(0);
    }
  }

  /** Ask for the checks of the rows until all have a verdict: one question a subject. */
  async follow() {
    if (this.isFollowing) return;
    this.isFollowing = true;
    while (this.rows.some(({ stage }) => ACTIVE.includes(stage))) {
      await pause(EVERY_MS);
      const checking = this.rows.filter(({ stage }) => stage === "checking");
      for (const subjectId of new Set(checking.map(({ order }) => order.subjectId))) {
        await this.hear(subjectId, checking).catch(() => {}); // the next round asks again
      }
    }
    this.isFollowing = false;
  }

  async hear(subjectId, rows) {
    const { items } = await get("/v1/jobs", { subject_id: subjectId, kind: "check_scan", limit: 200 });
    const jobs = new Map(items.map((job) => [job.id, job]));
    for (const row of rows) if (jobs.has(row.jobId)) await row.hear(jobs.get(row.jobId));
  }
}

/** Let the bar at the top say how many uploads are left. */
function tellUploads(left) {
  document.dispatchEvent(new CustomEvent("uploads", { detail: left }));
}

/** Say what else can be dropped, by the endings that name its role. */
function otherFiles(roles) {
  return roles
    .filter(({ own_formats: own }) => own.length)
    .map(({ noun, own_formats: own }) => `${noun} ${own.join(" ")}`)
    .join("; ");
}

function repeated(names) {
  const alike = names.map((name) => name.toLowerCase()); // one morph target to many programs
  return names.find((_, i) => alike.indexOf(alike[i]) !== i);
}
