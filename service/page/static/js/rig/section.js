// A section through the flesh: where a plane cuts the tetrahedra, coloured by their main muscle.

import {
  BufferAttribute, BufferGeometry, DoubleSide, Group, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, Plane, Vector3,
} from "../../vendor/three.js";
import { FLESH } from "./colours.js";
import { NO_MUSCLE } from "./inside.js";

export const AXES = { x: 0, y: 1, z: 2 };
const LINE = "#20120c";

/** The cut face and the outlines of skin and bones in it; `group` is to be added to a scene. */
export class Section {
  #cut = new Mesh(new BufferGeometry(), new MeshBasicMaterial({ vertexColors: true, side: DoubleSide }));
  #lines = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: LINE }));

  constructor() {
    this.plane = new Plane(new Vector3(0, 0, -1), 0);
    this.group = new Group();
    this.group.add(this.#cut, this.#lines);
    for (const object of this.group.children) object.frustumCulled = false;
  }

  /**
   * Cut at `at` mm along an axis. `inside` has the flesh, `outlines` are [places, faces, matrix] of
   * closed surfaces whose outline is drawn, the matrix null where they stand as they are.
   */
  cut(axis, at, inside, outlines) {
    const { chosen } = inside; // if muscles are, they alone have their colours
    const colours = inside.names.map((name) => (chosen.length && !chosen.includes(name) ? FLESH : inside.colours.get(name)));
    colours.push(FLESH);
    const face = cutTets(inside.x, inside.tets, AXES[axis], at, (tet) => {
      const number = inside.mainMuscle[tet];
      return colours[number === NO_MUSCLE ? colours.length - 1 : number];
    });
    set(this.#cut.geometry, face.places, face.colours);
    set(this.#lines.geometry, outlines.flatMap(([places, faces, matrix]) => (
      cutSurface(matrix ? moved(places, matrix) : places, faces, AXES[axis], at)
    )));
  }

  /** Keep the side that the camera does not stand on. */
  turnTo(axis, at, camera) {
    const side = camera.position.getComponent(AXES[axis]) > at ? -1 : 1;
    this.plane.normal.set(0, 0, 0).setComponent(AXES[axis], side);
    this.plane.constant = -side * at;
  }
}

function set(geometry, places, colours = null) {
  geometry.setAttribute("position", new BufferAttribute(Float32Array.from(places), 3));
  if (colours) geometry.setAttribute("color", new BufferAttribute(Float32Array.from(colours), 3));
}

/**
 * Return the triangles (flat x, y, z) in which the plane cuts the tets and their colours.
 *
 * A tet is cut in a triangle, one corner on one side, or in a quadrilateral, two on either side.
 */
export function cutTets(x, tets, axis, at, colourOf) {
  const places = [];
  const colours = [];
  for (let tet = 0; tet < tets.length / 4; tet++) {
    const above = [];
    const below = [];
    for (let corner = 0; corner < 4; corner++) {
      const vertex = tets[4 * tet + corner];
      (x[3 * vertex + axis] > at ? above : below).push(vertex);
    }
    if (above.length === 0 || below.length === 0) continue;
    const points = [];
    if (above.length === 2) {
      // round the quadrilateral: each edge shares a vertex with the next
      for (const [a, b] of [[0, 0], [0, 1], [1, 1], [1, 0]]) points.push(meet(x, above[a], below[b], axis, at));
    } else {
      for (const a of above) for (const b of below) points.push(meet(x, a, b, axis, at));
    }
    const colour = colourOf(tet);
    for (let i = 2; i < points.length; i++) {
      for (const point of [points[0], points[i - 1], points[i]]) {
        places.push(...point);
        colours.push(...colour);
      }
    }
  }
  return { places, colours };
}

/** Return the line segments (flat x, y, z) in which the plane cuts triangles. */
export function cutSurface(places, faces, axis, at) {
  const segments = [];
  for (let i = 0; i < faces.length; i += 3) {
    const corners = [faces[i], faces[i + 1], faces[i + 2]];
    const isAbove = corners.map((vertex) => places[3 * vertex + axis] > at);
    if (isAbove.every((value) => value === isAbove[0])) continue;
    for (let side = 0; side < 3; side++) {
      const next = (side + 1) % 3;
      if (isAbove[side] !== isAbove[next]) segments.push(...meet(places, corners[side], corners[next], axis, at));
    }
  }
  return segments;
}

/** Return where the edge from vertex a to b meets the plane. */
function meet(x, a, b, axis, at) {
  const from = x[3 * a + axis];
  const share = (at - from) / (x[3 * b + axis] - from);
  return [0, 1, 2].map((d) => x[3 * a + d] + share * (x[3 * b + d] - x[3 * a + d]));
}

function moved(places, matrix) {
  const out = new Float32Array(places.length);
  const point = new Vector3();
  for (let i = 0; i < places.length; i += 3) {
    point.fromArray(places, i).applyMatrix4(matrix).toArray(out, i);
  }
  return out;
}
