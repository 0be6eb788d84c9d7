// Markers in the canvas: a dot where each is on the fitted face, an arrow to where it was seen.

import { BufferAttribute, BufferGeometry, Color, DoubleSide, Group, Mesh, MeshBasicMaterial } from "../../vendor/three.js";

/** What became of a marker in a frame, by the names in `markers.bin`, and the colour of each. */
export const STATES = {
  seen: { title: "seen", colour: "#12a37b" },
  missing: { title: "gap", colour: "#8b9298" },
  outlier: { title: "outlier", colour: "#d6453d" },
  swapped: { title: "swap", colour: "#2f6fe0" },
  relabelled: { title: "other label", colour: "#9256d6" },
};

const RADIUS_MM = 2;
const ARROW_MM = 0.75; // half its width at the root
const LEAST_MM = 1e-3; // no arrow is shorter
const G = (1 + Math.sqrt(5)) / 2;
const CORNERS = [
  [-1, G, 0], [1, G, 0], [-1, -G, 0], [1, -G, 0], [0, -1, G], [0, 1, G],
  [0, -1, -G], [0, 1, -G], [G, 0, -1], [G, 0, 1], [-G, 0, -1], [-G, 0, 1],
].map((corner) => corner.map((each) => (each * RADIUS_MM) / Math.hypot(1, G)));
const BALL = [
  0, 11, 5, 0, 5, 1, 0, 1, 7, 0, 7, 10, 0, 10, 11, 1, 5, 9, 5, 11, 4, 11, 10, 2, 10, 7, 6, 7, 1, 8,
  3, 9, 4, 3, 4, 2, 3, 2, 6, 3, 6, 8, 3, 8, 9, 4, 9, 5, 2, 4, 11, 6, 2, 10, 8, 6, 7, 9, 8, 1,
];
const SPIKE = [0, 1, 3, 1, 2, 3, 2, 0, 3]; // three corners at the root and a tip

/** Dots and arrows of so many markers; `group` is to be added to a scene. */
export class MarkerSolids {
  #dots;
  #arrows;

  constructor(count) {
    this.#dots = solids(count, CORNERS.length, BALL);
    this.#arrows = solids(count, 4, SPIKE);
    this.group = new Group();
    this.group.add(this.#dots.mesh, this.#arrows.mesh);
    /** The mesh of the dots, for what is under a pointer. */
    this.dots = this.#dots.mesh;
  }

  /** Return the marker that a triangle of the dots belongs to. */
  markerOf(faceIndex) {
    return Math.floor(faceIndex / (BALL.length / 3));
  }

  /**
   * Place the markers; `places` and `off` are flat x, y, z in mm, `colours` are CSS, one a marker.
   *
   * Arrows are `times` as long as `off`, which may be NaN where there is none; `sizes` of dots are 1 by default.
   */
  set(places, off, colours, { times = 1, sizes = [] } = {}) {
    for (let k = 0; k < colours.length; k++) {
      const at = places.slice(3 * k, 3 * k + 3);
      const colour = new Color(colours[k]);
      this.#dots.set(k, CORNERS.map((corner) => corner.map((each, d) => (sizes[k] ?? 1) * each + at[d])), colour);
      const way = Array.from(off.slice(3 * k, 3 * k + 3), (each) => times * each);
      this.#arrows.set(k, spike(at, way), colour);
    }
    this.#dots.update();
    this.#arrows.update();
  }
}

function spike(at, way) {
  const length = Math.hypot(...way);
  if (!(length > LEAST_MM)) return [at, at, at, at];
  const along = way.map((each) => each / length);
  const other = Math.abs(along[0]) < 0.6 ? [1, 0, 0] : [0, 1, 0];
  const side = cross(along, other);
  const across = cross(along, side);
  const size = ARROW_MM / Math.hypot(...side);
  const root = [0, 1, 2].map((number) => {
    const angle = (2 * Math.PI * number) / 3;
    return at.map((each, d) => each + size * (Math.cos(angle) * side[d] + Math.sin(angle) * across[d]));
  });
  return [...root, at.map((each, d) => each + way[d])];
}

/** Return the cross product of two vectors. */
export function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

function solids(count, corners, triangles) {
  const places = new Float32Array(3 * corners * count);
  const colours = new Float32Array(3 * corners * count);
  const index = Uint32Array.from({ length: triangles.length * count }, (_, i) => (
    corners * Math.floor(i / triangles.length) + triangles[i % triangles.length]
  ));
  const geometry = new BufferGeometry();
  geometry.setIndex(new BufferAttribute(index, 1));
  geometry.setAttribute("position", new BufferAttribute(places, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  const mesh = new Mesh(geometry, new MeshBasicMaterial({ vertexColors: true, side: DoubleSide }));
  mesh.renderOrder = 20;
  mesh.frustumCulled = false;
  return {
    mesh,
    set(number, points, colour) {
      points.forEach((point, corner) => {
        const at = 3 * (corners * number + corner);
        places.set(point, at);
        colours.set([colour.r, colour.g, colour.b], at);
      });
    },
    update() {
      geometry.attributes.position.needsUpdate = true;
      geometry.attributes.color.needsUpdate = true;
      geometry.computeBoundingSphere();
    },
  };
}
