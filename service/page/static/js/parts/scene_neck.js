// The neck of a scene: chosen in a list, which writes it into the scene's JSON.

import { h, show } from "../dom.js";
import { capturesById } from "../library.js";

const NONE = "";
const BUILTIN = "built-in";
const OF_FILE = "file:";
const OPENSIM = ".osim";

/**
 * Add a list of necks to a form's `fields` where a kind's scene may have one, and return what reads
 * the chosen file: `read()` gives its id in a list, empty without one.
 *
 * OpenSim files among the person's assets are offered, of a job that reads what it did (`isAgain`)
 * those among its `captures` alone.
 */
export async function addNeckField(kind, fields, { subject_id: person, captures = [] }, isAgain = false) {
  const scene = fields.elements["option-scene"];
  const rules = scene && neckOf(kind.options);
  if (!rules) return { read: () => [] };
  const known = [...(await capturesById(person, captures)).values()].filter(({ id }) => !isAgain || captures.includes(id));
  const files = known.filter(({ role, filename }) => role === "asset" && filename.toLowerCase().endsWith(OPENSIM));
  const list = h("select", { id: "scene-neck", "aria-describedby": "scene-neck-help", onchange: () => write(scene, list.value) });
  const follow = () => showChoice(list, files, scene);
  scene.addEventListener("input", follow);
  follow();
  scene.closest(".field").after(h(
    "div",
    { class: "field" },
    h("label", { for: "scene-neck" }, "Neck"),
    list,
    h("span", { class: "fine", id: "scene-neck-help" }, `${rules.description}; it is written into the scene`),
  ));
  return { read: () => files.filter(({ name }) => list.value === OF_FILE + name).map(({ id }) => id) };
}

/** Return the schema of the neck of a kind's scenes, undefined without one. */
function neckOf({ properties, $defs }) {
  return $defs?.[properties.scene.$ref?.split("/").at(-1)]?.properties.neck;
}

/** Offer the necks that a scene may have, its own chosen; of what is no JSON none can be. */
function showChoice(list, files, scene) {
  const document = parsed(scene.value);
  const asset = document?.neck?.asset;
  const named = files.map(({ name }) => name);
  const names = typeof asset === "string" && !named.includes(asset) ? [...named, asset] : named;
  show(
    list,
    h("option", { value: NONE }, "none: the head turns about one point"),
    h("option", { value: BUILTIN }, "built-in"),
    names.map((name) => h("option", { value: OF_FILE + name }, `${name}, an OpenSim file`)),
  );
  list.disabled = document === null;
  list.value = document?.neck ? (asset ? OF_FILE + asset : BUILTIN) : NONE;
}

/** Write a choice into a scene; the neck's other members stay. */
function write(scene, choice) {
  const { neck, ...others } = parsed(scene.value);
  const { asset, ...kept } = neck ?? {};
  if (choice === NONE) scene.value = text(others);
  else scene.value = text({ ...others, neck: choice === BUILTIN ? kept : { asset: choice.slice(OF_FILE.length), ...kept } });
}

function text(document) {
  return JSON.stringify(document, null, 2);
}

/** Return a JSON object, null of anything else. */
function parsed(text) {
  try {
    const found = JSON.parse(text);
    return found !== null && typeof found === "object" && !Array.isArray(found) ? found : null;
  } catch {
    return null;
  }
}
