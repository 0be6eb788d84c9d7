// The state of the rig view as the query of its address, and back.
//
//   e=smile:0.4     an expression and its weight; once for each
//   m=frontalis_l:1 a muscle slider and its value; once for each, instead of `e`
//   take=JOB:12     a frame of a sequence, instead of both
//   live=SESSION    the face of a live session as it comes, instead of all these
//   heat=0-2        distance to the scan in this range of mm; `motion:0-10` is the way from the neutral
//   scan=clear      the scan over the fit: `clear`, `wire`, or `beside` it
//   inside=1        muscles and bones; muscle=NAME is the one that stands out
//   section=x:12    a cut at 12 mm on this axis
//   view=side       the camera, by name or as azimuth,elevation,zoom,x,y,z; without it the front,
//                   or where a section is seen from

import { CUT_VIEWS, VIEWS } from "./stage.js";

export const HEATS = ["distance", "motion", "difference", "movement"];
const SCANS = ["clear", "wire", "beside"];
const RANGE = /^(?:([a-z]+):)?(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)$/;

/** Return what a query asks for; what it says nothing of, or nothing that makes sense, is left out. */
export function fromQuery(query) {
  const state = {
    expressions: values(query.getAll("e")),
    controls: values(query.getAll("m")),
    scan: SCANS.includes(query.get("scan")) ? query.get("scan") : null,
    inside: query.get("inside") === "1",
    muscle: query.get("muscle"),
    heat: null,
    section: null,
    take: null,
    live: query.get("live"),
  };
  const heat = RANGE.exec(query.get("heat") ?? "");
  if (heat && HEATS.includes(heat[1] ?? "distance") && Number(heat[2]) < Number(heat[3])) {
    state.heat = { of: heat[1] ?? "distance", low: Number(heat[2]), high: Number(heat[3]) };
  }
  const section = /^([xyz]):(-?\d+(?:\.\d+)?)$/.exec(query.get("section") ?? "");
  if (section) state.section = { axis: section[1], at: Number(section[2]) };
  const take = /^([^:]+):(\d+)$/.exec(query.get("take") ?? "");
  if (take) state.take = { job: take[1], frame: Number(take[2]) };
  state.view = view(query.get("view") ?? "") ?? usualView(state);
  return state;
}

function view(text) {
  const numbers = text.split(",").map(Number);
  if (numbers.length === 6 && numbers.every(Number.isFinite) && numbers[2] > 0) return numbers;
  return text in VIEWS ? text : null;
}

/** Return the camera of an address that names none. */
function usualView({ section }) {
  return section ? CUT_VIEWS[section.axis] : "front";
}

/** Return the query, as text, that says what a state is. */
export function toQuery(state) {
  const parts = [];
  const add = (name, value) => parts.push(`${name}=${readable(value)}`);
  for (const [name, value] of state.expressions) add("e", `${name}:${short(value)}`);
  for (const [name, value] of state.controls) add("m", `${name}:${short(value)}`);
  if (state.take) add("take", `${state.take.job}:${state.take.frame}`);
  if (state.live) add("live", state.live);
  if (state.heat) {
    const { of, low, high } = state.heat;
    add("heat", `${of === "distance" ? "" : `${of}:`}${short(low)}-${short(high)}`);
  }
  if (state.scan) add("scan", state.scan);
  if (state.inside) add("inside", "1");
  if (state.muscle) add("muscle", state.muscle);
  if (state.section) add("section", `${state.section.axis}:${short(state.section.at)}`);
  if (String(state.view) !== String(usualView(state))) add("view", String(state.view));
  return parts.join("&");
}

function values(texts) {
  return new Map(texts.flatMap((text) => {
    const at = text.lastIndexOf(":");
    const value = at > 0 ? Number(text.slice(at + 1)) : NaN;
    return Number.isFinite(value) && value > 0 ? [[text.slice(0, at), Math.min(1, value)]] : [];
  }));
}

function short(value) {
  return Number(value.toFixed(2));
}

/** Escape only what a query cannot carry, so that the address can be read. */
function readable(text) {
  return encodeURIComponent(text).replaceAll("%3A", ":").replaceAll("%2C", ",").replaceAll("%20", "+");
}
