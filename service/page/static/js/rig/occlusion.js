// Ambient occlusion of each vertex of a face: dark nostrils, corners and folds.
//
// One small depth map per direction tells which vertices it reaches, as in the solver's pictures.

const DIRECTIONS = 28;
const MAP_PIXELS = 160;
const LIFT_MM = 1.5; // off the surface, so that a triangle does not shade its own corners
const BIAS_PIXELS = 1.5;
const GOLDEN_ANGLE = Math.PI * (3 - Math.sqrt(5));

/**
 * Return the share of light (one value per vertex) that reaches places with `normals`.
 *
 * It takes a few tenths of a second, direction by direction; the page can do other things between.
 * An aborted `signal` ends it by its reason.
 */
export async function occlusion(places, faces, normals, signal) {
  const count = places.length / 3;
  const light = new Float32Array(count);
  const whole = new Float32Array(count);
  const ball = about(places);
  for (let i = 0; i < DIRECTIONS; i++) {
    await new Promise((resolve) => { setTimeout(resolve); });
    signal.throwIfAborted();
    gather(places, faces, normals, axes(i), ball, light, whole);
  }
  return light.map((value, i) => (whole[i] > 0 ? value / whole[i] : 1));
}

/** Add what comes from one direction to `light`, and what would without anything in the way to `whole`. */
function gather(places, faces, normals, [right, up, towards], { centre, radius }, light, whole) {
  const scale = MAP_PIXELS / (2 * radius);
  const flat = new Float32Array(places.length);
  for (let i = 0; i < places.length; i += 3) {
    const p = [places[i] - centre[0], places[i + 1] - centre[1], places[i + 2] - centre[2]];
    flat[i] = (dot(p, right) + radius) * scale;
    flat[i + 1] = (dot(p, up) + radius) * scale;
    flat[i + 2] = dot(p, towards) * scale;
  }
  const nearest = depths(flat, faces);
  for (let v = 0, i = 0; i < places.length; v++, i += 3) {
    const n = [normals[i], normals[i + 1], normals[i + 2]];
    const length = Math.hypot(...n) || 1;
    const cosine = dot(n, towards) / length;
    if (cosine <= 0) continue;
    whole[v] += cosine;
    const lift = (LIFT_MM * scale) / length;
    const column = Math.trunc(flat[i] + lift * dot(n, right));
    const row = Math.trunc(flat[i + 1] + lift * dot(n, up));
    if (flat[i + 2] + lift * dot(n, towards) > nearest[row * MAP_PIXELS + column] - BIAS_PIXELS) light[v] += cosine;
  }
}

/** Return the greatest third coordinate of triangles in each pixel. */
function depths(flat, faces) {
  const nearest = new Float32Array(MAP_PIXELS * MAP_PIXELS).fill(-Infinity);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f];
    const b = 3 * faces[f + 1];
    const c = 3 * faces[f + 2];
    const area = (flat[b] - flat[a]) * (flat[c + 1] - flat[a + 1]) - (flat[c] - flat[a]) * (flat[b + 1] - flat[a + 1]);
    if (area === 0) continue;
    const left = Math.ceil(Math.min(flat[a], flat[b], flat[c]) - 0.5);
    const last = Math.floor(Math.max(flat[a], flat[b], flat[c]) - 0.5);
    const top = Math.ceil(Math.min(flat[a + 1], flat[b + 1], flat[c + 1]) - 0.5);
    const bottom = Math.floor(Math.max(flat[a + 1], flat[b + 1], flat[c + 1]) - 0.5);
    for (let row = top; row <= bottom; row++) {
      for (let column = left; column <= last; column++) {
        const x = column + 0.5;
        const y = row + 0.5;
        const u = ((flat[b] - x) * (flat[c + 1] - y) - (flat[c] - x) * (flat[b + 1] - y)) / area;
        const v = ((flat[c] - x) * (flat[a + 1] - y) - (flat[a] - x) * (flat[c + 1] - y)) / area;
        const w = 1 - u - v;
        if (u < 0 || v < 0 || w < 0) continue;
        const depth = u * flat[a + 2] + v * flat[b + 2] + w * flat[c + 2];
        const pixel = row * MAP_PIXELS + column;
        if (depth > nearest[pixel]) nearest[pixel] = depth;
      }
    }
  }
  return nearest;
}

/** Return unit vectors of a map that looks along direction `i` of a sphere's even spread. */
function axes(i) {
  const y = 1 - (2 * (i + 0.5)) / DIRECTIONS;
  const ring = Math.sqrt(1 - y * y);
  const towards = [ring * Math.cos(GOLDEN_ANGLE * i), y, ring * Math.sin(GOLDEN_ANGLE * i)];
  const helper = Math.abs(towards[0]) < 0.7 ? [1, 0, 0] : [0, 1, 0];
  const across = cross(helper, towards);
  const length = Math.hypot(...across);
  const right = across.map((value) => value / length);
  return [right, cross(towards, right), towards];
}

/** Return a ball about all places, with room for lifted ones. */
function about(places) {
  const centre = [0, 0, 0];
  for (let i = 0; i < places.length; i++) centre[i % 3] += (3 * places[i]) / places.length;
  let radius = 0;
  for (let i = 0; i < places.length; i += 3) {
    radius = Math.max(radius, Math.hypot(places[i] - centre[0], places[i + 1] - centre[1], places[i + 2] - centre[2]));
  }
  return { centre, radius: radius + 2 * LIFT_MM };
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
