// A session's marker set that can be changed: where each label sits on a person's skin.

import { cross } from "./marker_solids.js";
import { twins } from "./marker_twins.js";

export const PARTS = { face: "Face", head: "Head", upper_teeth: "Upper teeth", lower_teeth: "Lower teeth", ignore: "Left out" };
const LONGEST_LABEL = 64;

/** A set over the skin of a `Face` at rest; `document` is what `markers.json` holds. */
export class MarkerSet {
  #document;
  #neutral;
  #faces;
  #sagittal;
  #seen;
  #twins;

  constructor(document, { neutral, faces, sagittal }) {
    this.#document = document;
    this.#neutral = neutral;
    this.#faces = faces;
    this.#sagittal = sagittal;
    this.markers = document.markers.map((each) => structuredClone(each));
    this.#seen = this.markers.map((marker) => this.placeOf(marker));
    this.#twins = twins(this.markers.map(({ label }) => label), this.#seen, (place) => this.#mirrored(place));
  }

  /** Return which marker lies on the other side of the face as `k` does, by name or place; -1 if none does. */
  twin(k) {
    return this.#twins[k];
  }

  /** Put the twin of marker `k` where the skin is nearest to the mirror image of `k`. */
  mirror(k) {
    if (this.#twins[k] >= 0) this.putNear(this.#twins[k], this.#mirrored(this.placeOf(this.markers[k])));
  }

  /** Return the way out of the skin under marker `k`, of length 1; null for what rides on bone. */
  outward(k) {
    const { at } = this.markers[k];
    return Array.isArray(at) ? null : this.#normal(at.vertices.map((vertex) => this.#corner(vertex)));
  }

  /** Return where a marker is: over the skin, or on its bone. */
  placeOf({ at, height_mm: height }) {
    if (Array.isArray(at)) return at;
    const corners = at.vertices.map((vertex) => this.#corner(vertex));
    const foot = [0, 1, 2].map((d) => corners.reduce((sum, corner, i) => sum + at.weights[i] * corner[d], 0));
    const normal = this.#normal(corners);
    return foot.map((each, d) => each + height * normal[d]);
  }

  /** Return where marker `k` was in the take, as the set was proposed. */
  seen(k) {
    return this.#seen[k];
  }

  /** Return how far marker `k` was moved from there, mm. */
  moved(k) {
    return Math.hypot(...minus(this.placeOf(this.markers[k]), this.#seen[k]));
  }

  /** Put marker `k` on the skin's triangle of these vertices, at the point of it that is nearest to `point`. */
  put(k, vertices, point) {
    const marker = this.markers[k];
    const weights = sharesIn(vertices.map((vertex) => this.#corner(vertex)), point).weights;
    this.markers[k] = { ...marker, part: "face", at: { vertices, weights } };
  }

  /** Put marker `k` where the skin is nearest to `point`. */
  putNear(k, point) {
    const { vertices } = this.#nearest(point);
    this.put(k, vertices, point);
  }

  /** Say what marker `k` rides on; its place stays what it is. */
  setPart(k, part) {
    const marker = this.markers[k];
    const isBony = part !== "face" && part !== "ignore";
    const place = this.placeOf(marker);
    if (isBony) this.markers[k] = { ...marker, part, at: place, height_mm: 0 };
    else if (Array.isArray(marker.at)) {
      const { vertices, weights, away } = this.#nearest(place);
      this.markers[k] = { ...marker, part, at: { vertices, weights }, height_mm: away };
    } else this.markers[k] = { ...marker, part };
  }

  /** Name marker `k`; returns why not, if the name cannot be. */
  rename(k, label) {
    const name = label.trim();
    if (!name || name.length > LONGEST_LABEL) return `A label has 1 to ${LONGEST_LABEL} characters.`;
    if (this.markers.some((each, i) => i !== k && each.label === name)) return `Another marker is called ${name}.`;
    this.markers[k] = { ...this.markers[k], label: name };
    return null;
  }

  /** Return the set as `markers.json` holds it. */
  toJSON() {
    return { ...this.#document, markers: this.markers };
  }

  /** Return the triangle nearest to a point, the shares of its corners there, and how far off it is. */
  #nearest(point) {
    let best = { away: Infinity };
    for (let i = 0; i < this.#faces.length; i += 3) {
      const vertices = [this.#faces[i], this.#faces[i + 1], this.#faces[i + 2]];
      const corner = this.#corner(vertices[0]);
      if (Math.hypot(...minus(corner, point)) > best.away + LONGEST_EDGE_MM) continue;
      const found = sharesIn(vertices.map((vertex) => this.#corner(vertex)), point);
      if (found.away < best.away) best = { vertices, ...found };
    }
    return best;
  }

  #normal(corners) {
    return unit(cross(minus(corners[1], corners[0]), minus(corners[2], corners[0])));
  }

  #mirrored(place) {
    const { at, across } = this.#sagittal;
    const off = dot(minus(place, at), across);
    return place.map((each, d) => each - 2 * off * across[d]);
  }

  #corner(vertex) {
    return Array.from(this.#neutral.subarray(3 * vertex, 3 * vertex + 3));
  }
}

const LONGEST_EDGE_MM = 40; // of a triangle of a face

/** Return the shares of a triangle's corners at its point nearest to `point`, and how far off that is. */
export function sharesIn([a, b, c], point) {
  // Ericson 2004, Real-Time Collision Detection, 5.1.5
  const ab = minus(b, a);
  const ac = minus(c, a);
  const from = (corner) => [dot(ab, minus(point, corner)), dot(ac, minus(point, corner))];
  const [d1, d2] = from(a);
  const [d3, d4] = from(b);
  const [d5, d6] = from(c);
  const at = (u, v) => {
    const weights = [1 - u - v, u, v];
    const place = [0, 1, 2].map((d) => weights[0] * a[d] + u * b[d] + v * c[d]);
    return { weights, away: Math.hypot(...minus(point, place)) };
  };
  if (d1 <= 0 && d2 <= 0) return at(0, 0);
  if (d3 >= 0 && d4 <= d3) return at(1, 0);
  if (d6 >= 0 && d5 <= d6) return at(0, 1);
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return at(d1 / (d1 - d3), 0);
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return at(0, d2 / (d2 - d6));
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 >= d3 && d5 >= d6) {
    const share = (d4 - d3) / (d4 - d3 + (d5 - d6));
    return at(1 - share, share);
  }
  const whole = va + vb + vc;
  return at(vb / whole, vc / whole);
}

function minus(a, b) {
  return a.map((each, d) => each - b[d]);
}

function dot(a, b) {
  return a.reduce((sum, each, d) => sum + each * b[d], 0);
}

function unit(vector) {
  const length = Math.hypot(...vector) || 1;
  return vector.map((each) => each / length);
}
