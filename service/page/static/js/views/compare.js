// Two rigs beside each other, or two systems of one: `/compare?a=RIG&b=RIG.T`.

import * as api from "../api.js";
import { h, show } from "../dom.js";
import { navigate, replaceQuery } from "../navigate.js";
import { changed, names, subjectsById } from "../library.js";
import { short, when } from "../words.js";
import { ComparePage } from "../rig/compare_page.js";
import { Face } from "../rig/face.js";
import { fromQuery, toQuery } from "../rig/link.js";
import { SYSTEMS, bySystem, firstSystem, idAndSystem, rigAndView } from "../rig/read.js";

export async function mount(root, params, query) {
  const ending = new AbortController();
  const { signal } = ending;
  const ids = [query.get("a"), query.get("b")];
  const head = h("header", { class: "head" }, h("h1", {}, "Compare"), await pickers(ids, signal));
  if (!ids[0] || !ids[1]) {
    show(root, head, h("p", { class: "empty" }, "Choose two rigs."));
    return () => ending.abort();
  }
  const sides = await Promise.all(ids.map(async (text) => {
    const { rig, subject, system, buffer } = await rigAndView(text, signal);
    const name = system === firstSystem(rig) ? subject.name : `${subject.name}, ${SYSTEMS[system].toLowerCase()}`;
    return { rig: bySystem(rig, system), subject: { ...subject, name }, face: buffer && new Face(buffer) };
  }));
  const old = sides.filter(({ face }) => !face);
  if (old.length) {
    show(root, head, h("p", { class: "notice" }, "A rig that was made before rigs could be shown here cannot be compared: fit it again."));
    return () => ending.abort();
  }
  const page = new ComparePage(sides, fromQuery(query), signal);
  page.addEventListener("change", () => {
    replaceQuery([`a=${ids[0]}`, `b=${ids[1]}`, toQuery(page.state)].filter(Boolean).join("&"));
  });
  show(root, head, page.element);
  page.start();
  performance.mark("rig-shown");
  return () => {
    ending.abort();
    page.dispose();
  };
}

/** Return two lists of all rigs, by their subjects' names. */
async function pickers(ids, signal) {
  changed(); // others add subjects too
  const [rigs, subjects] = await Promise.all([
    api.all("/v1/rigs", {}, signal), subjectsById(),
  ]);
  const people = names(subjects);
  return ids.map((chosen, i) => {
    const select = h("select", {
      id: `compare-${"ab"[i]}`,
      onchange: () => {
        const next = ids.map((id, k) => (k === i ? select.value : id));
        navigate(`/compare?${["a", "b"].flatMap((name, k) => (next[k] ? [`${name}=${next[k]}`] : [])).join("&")}`);
      },
    }, h("option", { value: "" }, "Choose a rig"), rigs.map((rig) => h("option", { value: rig.id, selected: rig.id === idAndSystem(chosen ?? "")[0] },
      `${people.get(rig.subject_id) ?? "a subject"}, ${rig.name || when(rig.created_at)}, ${short(rig.id)}`)));
    return h("div", { class: "row" }, h("label", { for: select.id }, "AB"[i]), select);
  });
}
