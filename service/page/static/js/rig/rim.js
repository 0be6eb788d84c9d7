// The rim of the neck, where a face's topology ends: its last triangles stick out like torn paper.

import { Plane, Vector3 } from "../../vendor/three.js";
import { components } from "./parts.js";

const INSIDE_MM = 1; // of the rim's inmost vertex: expressions move it a little
const DEEPEST_MM = 40; // a rim that is more uneven than this is no rim of a neck

/**
 * Return the plane that cuts a face just inside its widest opening, null if it has none.
 *
 * `faces` are those of the skin alone. The plane's normal is the opening's area vector, as the
 * directed edges around it give it (Newell's method).
 */
export function rimPlane(places, faces) {
  const edges = openEdges(places.length / 3, faces);
  if (!edges.length) return null;
  const loop = components(places.length / 3, Uint32Array.from(edges.flatMap(([a, b]) => [a, b, b])));
  const normals = new Map();
  const [a, b] = [new Vector3(), new Vector3()];
  for (const edge of edges) {
    if (!normals.has(loop[edge[0]])) normals.set(loop[edge[0]], new Vector3());
    normals.get(loop[edge[0]]).add(a.fromArray(places, 3 * edge[0]).cross(b.fromArray(places, 3 * edge[1])));
  }
  const [widest, area] = [...normals].reduce((best, each) => (each[1].lengthSq() > best[1].lengthSq() ? each : best));
  const normal = area.normalize();
  const rim = edges.filter(([vertex]) => loop[vertex] === widest).map(([vertex]) => vertex);
  if (meanAlong(normal, places, faces) < meanAlong(normal, places, rim)) normal.negate();
  const along = rim.map((vertex) => normal.dot(a.fromArray(places, 3 * vertex)));
  const inmost = Math.max(...along);
  return inmost - Math.min(...along) < DEEPEST_MM ? new Plane(normal, -inmost - INSIDE_MM) : null;
}

/** Return the edges [from, to] that only one face has, in the direction in which it has them. */
function openEdges(count, faces) {
  const edges = new Map();
  for (let i = 0; i < faces.length; i++) {
    const from = faces[i];
    const to = faces[i % 3 === 2 ? i - 2 : i + 1];
    const key = Math.min(from, to) * count + Math.max(from, to);
    if (!edges.delete(key)) edges.set(key, [from, to]);
  }
  return [...edges.values()];
}

function meanAlong(normal, places, vertices) {
  let sum = 0;
  for (const vertex of vertices) {
    sum += normal.x * places[3 * vertex] + normal.y * places[3 * vertex + 1] + normal.z * places[3 * vertex + 2];
  }
  return sum / vertices.length;
}
