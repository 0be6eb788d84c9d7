// Parts of a face by vertex: skin, eyes, teeth, the rest of the mouth, lashes.
//
// The files do not name them, so they are told apart by shape, as the solver's pictures do: they are
// separate components; eyeballs are round, and what is small lies at an eye or is a tooth.

const EYE_RADIUS_MM = [9, 18];
const ROUNDNESS = 0.07; // deviation from the best sphere, by its radius (the cornea's bulge gives 0.04)
const NEAR_EYE = 2.2; // radii: lashes and tear film lie within
const TOOTH_MM = 34; // crown and root

/**
 * Return the parts of a face: `names`, the part of each vertex, and `eyes`, the `centre` and the
 * `vertices` of each eyeball.
 */
export function partsOf(places, faces) {
  const label = components(places.length / 3, faces);
  const pieces = new Map();
  label.forEach((piece, vertex) => {
    if (!pieces.has(piece)) pieces.set(piece, []);
    pieces.get(piece).push(vertex);
  });
  const shapes = new Map([...pieces].map(([piece, vertices]) => [piece, shape(places, vertices)]));
  const largest = [...shapes].reduce((a, b) => (b[1].vertices.length > a[1].vertices.length ? b : a))[0];
  const eyes = [...shapes.values()].filter((piece) => piece.round);
  const kinds = new Map([...shapes].map(([piece, it]) => [piece, kind(it, piece === largest, eyes)]));
  const found = [...kinds.values()];
  if (!found.includes("teeth")) { // rows of teeth in one piece: wider than deep, as no tongue is
    for (const [piece, { size: [wide, , deep] }] of shapes) {
      if (kinds.get(piece) === "mouth" && wide > deep) kinds.set(piece, "teeth");
    }
  }
  return { names: Array.from(label, (piece) => kinds.get(piece)), eyes };
}

function kind(it, isLargest, eyes) {
  if (isLargest) return "skin";
  if (it.round) return "eyes";
  const near = (eye) => Math.hypot(...it.centre.map((value, d) => value - eye.centre[d])) < NEAR_EYE * eye.radius;
  if (eyes.some(near)) return "lashes";
  return Math.max(...it.size) < TOOTH_MM ? "teeth" : "mouth";
}

/** Return extent and roundness of some vertices; an eye has the centre and radius of its ball. */
function shape(places, vertices) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  const mean = [0, 0, 0];
  for (const vertex of vertices) {
    for (let d = 0; d < 3; d++) {
      const value = places[3 * vertex + d];
      mean[d] += value / vertices.length;
      if (value < low[d]) low[d] = value;
      if (value > high[d]) high[d] = value;
    }
  }
  const size = high.map((value, d) => value - low[d]);
  const { centre, radius, deviation } = sphere(places, vertices, mean);
  const round = vertices.length >= 12 && radius > EYE_RADIUS_MM[0] && radius < EYE_RADIUS_MM[1]
    && deviation < ROUNDNESS * radius && Math.min(...size) > 1.6 * radius;
  return { vertices, centre: round ? centre : mean, size, radius, round };
}

/** Return the sphere that is nearest to some vertices by least squares, and how far they are off it. */
function sphere(places, vertices, mean) {
  // |p - c|^2 = r^2 is linear in c and r^2 - |c|^2; about the mean the system is well set
  const rows = Array.from({ length: 4 }, () => new Float64Array(5));
  for (const vertex of vertices) {
    const p = mean.map((value, d) => places[3 * vertex + d] - value);
    const row = [2 * p[0], 2 * p[1], 2 * p[2], 1, p[0] ** 2 + p[1] ** 2 + p[2] ** 2];
    for (let i = 0; i < 4; i++) for (let j = 0; j < 5; j++) rows[i][j] += row[i] * row[j];
  }
  const [x, y, z, rest] = solved(rows);
  const centre = [mean[0] + x, mean[1] + y, mean[2] + z];
  const far = vertices.map((vertex) => Math.hypot(...centre.map((value, d) => places[3 * vertex + d] - value)));
  const radius = Math.sqrt(Math.max(0, rest + x * x + y * y + z * z));
  const off = far.reduce((sum, value) => sum + (value - radius) ** 2, 0);
  return { centre, radius, deviation: Math.sqrt(off / far.length) };
}

/** Solve a small linear system, given as rows with their right side last, by elimination. */
function solved(rows) {
  const count = rows.length;
  for (let i = 0; i < count; i++) {
    const pivot = rows.reduce((best, row, k) => (k >= i && Math.abs(row[i]) > Math.abs(rows[best][i]) ? k : best), i);
    [rows[i], rows[pivot]] = [rows[pivot], rows[i]];
    for (let k = 0; k < count; k++) {
      const share = k === i ? 0 : rows[k][i] / rows[i][i];
      for (let j = i; j <= count; j++) rows[k][j] -= share * rows[i][j];
    }
  }
  return rows.map((row, i) => row[count] / row[i]);
}

/** Return the component of each vertex: the number of one of its vertices. */
export function components(count, faces) {
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
