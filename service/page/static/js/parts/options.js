// A form for a kind's options, made of their JSON Schema.

import { h } from "../dom.js";
import { plain } from "../words.js";

/** Return a fieldset of `schema`'s options; those in `given` are filled in. */
export function optionFields(schema, given = {}) {
  const fields = Object.entries(schema.properties).map(([name, rules]) => field(name, rules, given[name]));
  return h(
    "fieldset",
    { class: "options" },
    h("legend", { class: "unseen" }, "Options"),
    fields.length ? fields : h("p", { class: "fine" }, "This kind of job has no options."),
  );
}

/** Return the options that a form says, without those left as they were in `given` or by default. */
export function readOptions(schema, form, given = {}) {
  const options = {};
  for (const [name, rules] of Object.entries(schema.properties)) {
    const value = read(form.elements[`option-${name}`], rules);
    if (!areAlike(value, given[name] ?? rules.default ?? null)) options[name] = value;
  }
  return options;
}

/** Tell whether two JSON values are the same. */
function areAlike(one, other) {
  return JSON.stringify(one) === JSON.stringify(other);
}

function field(name, rules, given) {
  const value = given ?? rules.default ?? null;
  const id = `option-${name}`;
  const help = rules.description && h("span", { class: "fine", id: `${id}-help` }, rules.description);
  const shared = { name: id, id, "aria-describedby": help ? `${id}-help` : null };
  if (rules.type === "boolean") {
    const box = h("input", { ...shared, type: "checkbox" });
    box.checked = value === true;
    return h("div", { class: "field" }, h("label", { class: "check-field" }, box, plain(name)), help);
  }
  return h(
    "div",
    { class: isDocument(rules) ? "field whole" : "field" },
    h("label", { for: id }, plain(name)),
    control(shared, rules, value),
    help,
  );
}

function control(shared, rules, value) {
  if (rules.enum) {
    const select = h(
      "select",
      shared,
      rules.enum.map((choice) =>
        h("option", { value: JSON.stringify(choice) }, choice === null ? "automatic" : String(choice)),
      ),
    );
    select.value = JSON.stringify(value);
    return select;
  }
  const types = [rules.type].flat();
  if (types.includes("number") || types.includes("integer")) {
    return h("input", {
      ...shared,
      type: "number",
      step: types.includes("integer") ? 1 : "any",
      min: rules.minimum ?? rules.exclusiveMinimum,
      max: rules.maximum,
      required: !types.includes("null"),
      placeholder: types.includes("null") ? "none" : null,
      value,
    });
  }
  if (isDocument(rules)) {
    return h(
      "textarea",
      { ...shared, rows: 14, required: true, spellcheck: "false", autocomplete: "off" },
      JSON.stringify(value ?? {}, null, 2),
    );
  }
  const text = h("input", { ...shared, type: "text", value: value === null ? "" : asText(value) });
  const words = formsOf(rules).flatMap(({ enum: choices = [] }) => choices);
  if (!words.length) return text;
  text.setAttribute("list", `${shared.id}-words`);
  text.required = true;
  return [text, h("datalist", { id: `${shared.id}-words` }, words.map((word) => h("option", { value: word })))];
}

/** Return the forms that a value may have, such as a word or a number. */
function formsOf(rules) {
  return [...(rules.anyOf ?? []), ...(rules.oneOf ?? [])];
}

/** Tell whether an option is a whole JSON document, such as a scene. */
function isDocument(rules) {
  return "$ref" in rules || rules.type === "object";
}

function asText(value) {
  return typeof value === "string" ? value : JSON.stringify(value);
}

function read(element, rules) {
  if (rules.type === "boolean") return element.checked;
  if (rules.enum) return JSON.parse(element.value);
  if (element.value === "") return null;
  if (element.type === "number") return Number(element.value);
  if (rules.type === "string") return element.value;
  try {
    return JSON.parse(element.value);
  } catch {
    return element.value; // the service says what it should be
  }
}
