// Dialogs that change a subject, a scan or a rig: names, role, labels.

import { ApiProblem, patch } from "../api.js";
import { h } from "../dom.js";
import { rolesByName } from "../library.js";
import { NAME } from "../scan_files.js";
import { ask } from "./dialog.js";

/** Ask for changes of a subject; resolves to it as it is then, or null. */
export async function askToEditSubject(subject) {
  const name = text("Name", { value: subject.name, required: true, maxlength: 200 });
  return edit(`Edit ${subject.name}`, `/v1/subjects/${subject.id}`, subject, { name });
}

/** Ask for changes of a scan; name and role stay while jobs of its subject are not over. */
export async function askToEditCapture(capture) {
  const roles = await rolesByName();
  const isScan = roles.get(capture.role).is_scan;
  const scans = [...roles.values()].filter((each) => each.is_scan);
  const role = h(
    "select",
    {},
    scans.map((each) => h("option", { value: each.role, selected: each.role === capture.role }, each.title)),
  );
  return edit(`Edit the scan ${capture.name}`, `/v1/subjects/${capture.subject_id}/captures/${capture.id}`, capture, {
    title: text("Title", { value: capture.title, required: true, maxlength: 200 }),
    name: text("Name", { value: capture.name, required: true, pattern: NAME, spellcheck: "false" }),
    ...(isScan ? { role: field("Role", role, "In another role it is to be checked and registered again.") } : {}),
  });
}

/** Ask for changes of a rig. */
export async function askToEditRig(rig) {
  const name = text("Name", { value: rig.name, maxlength: 200 });
  return edit("Edit the rig", `/v1/rigs/${rig.id}`, rig, { name });
}

/** Ask for the fields that differ and the labels, and send them. */
function edit(title, path, before, fields) {
  const lines = Object.entries(before.labels).map(([key, value]) => `${key}: ${value}`);
  const area = h("textarea", { rows: Math.max(3, lines.length + 1), placeholder: "session: Monday" }, lines.join("\n"));
  const labels = field("Labels", area, "One a line, as key: value.");
  return ask({
    title,
    body: h("div", { class: "stack" }, Object.values(fields), labels),
    agree: "Save",
    act: () => {
      const given = Object.entries(fields).map(([key, element]) => [key, element.querySelector("input, select, textarea").value]);
      const changes = Object.fromEntries(given.filter(([key, value]) => value !== before[key]));
      return patch(path, { ...changes, labels: labelChanges(before.labels, area.value) });
    },
  });
}

/** Return labels as the API is told: those that are gone are null. */
function labelChanges(before, words) {
  const gone = Object.fromEntries(Object.keys(before).map((key) => [key, null]));
  const now = words.split("\n").filter((line) => line.trim()).map(labelOf);
  return { ...gone, ...Object.fromEntries(now) };
}

function labelOf(line) {
  const colon = line.indexOf(":");
  if (colon > 0) return [line.slice(0, colon).trim(), line.slice(colon + 1).trim()];
  throw new ApiProblem({ status: 0, code: "page.label", detail: `"${line.trim()}" is no label: write it as key: value` });
}

function text(name, attributes) {
  return field(name, h("input", { type: "text", autocomplete: "off", ...attributes }));
}

function field(name, control, help = null) {
  return h("label", { class: "field" }, h("span", {}, name), control, help && h("span", { class: "fine" }, help));
}
