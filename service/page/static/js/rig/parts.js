// Which vertices of a face are skin, eyes, teeth, the rest of the mouth, lashes.
//
// The files do not name them, so they are told apart by shape, as the solver's pictures do: they are
// separate components; eyeballs are round, and what is small lies at an eye or is a tooth.

const EYE_RADIUS_MM = [9, 18];
const ROUNDNESS = 0.09; // deviation from the radius, by the radius
const NEAR_EYE = 2.2; // radii: lashes and tear film lie within
const TOOTH_MM = 34; // crown and root

/** Return the part of each vertex, by its name. */
export function partsOf(places, faces) {
  const label = components(places.length / 3, faces);
  const pieces = new Map();
  label.forEach((piece, vertex) => {
    if (!pieces.has(piece)) pieces.set(piece, []);
    pieces.get(piece).push(vertex);
  });
  const shapes = new Map([...pieces].map(([piece, vertices]) => [piece, shape(places, vertices)]));
  const largest = [...shapes].reduce((a, b) => (b[1].count > a[1].count ? b : a))[0];
  const eyes = [...shapes.values()].filter((piece) => piece.round);
  const kinds = new Map([...shapes].map(([piece, it]) => [piece, kind(it, piece === largest, eyes)]));
  const found = [...kinds.values()];
  if (!found.includes("teeth")) { // rows of teeth in one piece
    for (const [piece, name] of kinds) if (name === "mouth") kinds.set(piece, "teeth");
  }
  return Array.from(label, (piece) => kinds.get(piece));
}

function kind(it, isLargest, eyes) {
  if (isLargest) return "skin";
  if (it.round) return "eyes";
  const near = (eye) => Math.hypot(...it.centre.map((value, d) => value - eye.centre[d])) < NEAR_EYE * eye.radius;
  if (eyes.some(near)) return "lashes";
  return Math.max(...it.size) < TOOTH_MM ? "teeth" : "mouth";
}

/** Return extent and roundness of some vertices. */
function shape(places, vertices) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const vertex of vertices) {
    for (let d = 0; d < 3; d++) {
      const value = places[3 * vertex + d];
      if (value < low[d]) low[d] = value;
      if (value > high[d]) high[d] = value;
    }
  }
  const size = high.map((value, d) => value - low[d]);
  // the cornea bulges forward: across and up the ball is its true width
  const radius = (size[0] + size[1]) / 4;
  const centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2] + radius];
  let off = 0;
  for (const vertex of vertices) {
    const far = Math.hypot(...centre.map((value, d) => places[3 * vertex + d] - value));
    off += (far - radius) ** 2;
  }
  const deviation = Math.sqrt(off / vertices.length);
  const round = vertices.length >= 12 && radius > EYE_RADIUS_MM[0] && radius < EYE_RADIUS_MM[1]
    && deviation < ROUNDNESS * radius && Math.min(...size) > 1.6 * radius;
  return { count: vertices.length, centre, size, radius, round };
}

/** Return the component of each vertex: the number of one of its vertices. */
function components(count, faces) {
  const root = Uint32Array.from({ length: count }, (_, i) => i);
  const find = (vertex) => {
    while (root[vertex] !== vertex) {
      root[vertex] = root[root[vertex]];
      vertex = root[vertex];
    }
    return vertex;
  };
  for (let i = 0; i < faces.length; i += 3) {
    const a = find(faces[i]);
    root[find(faces[i + 1])] = a;
    root[find(faces[i + 2])] = a;
  }
  return root.map((_, vertex) => find(vertex));
}
