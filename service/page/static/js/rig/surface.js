// Surfaces that move: a geometry whose places are set anew, with smooth normals.

import { BufferAttribute, BufferGeometry } from "../../vendor/three.js";

/** A geometry of triangles `faces` over `places` (flat x, y, z in mm); `drawn` are those to draw. */
export class MovingSurface {
  #faces;

  constructor(places, faces, drawn = faces) {
    this.#faces = faces;
    this.places = new Float32Array(places);
    this.geometry = new BufferGeometry();
    this.geometry.setIndex(new BufferAttribute(drawn, 1));
    this.geometry.setAttribute("position", new BufferAttribute(this.places, 3));
    this.geometry.setAttribute("normal", new BufferAttribute(new Float32Array(places.length), 3));
    this.moved();
  }

  /** Take note of new `places`. */
  moved() {
    const { position, normal } = this.geometry.attributes;
    setNormals(this.places, this.#faces, normal.array);
    position.needsUpdate = true;
    normal.needsUpdate = true;
    this.geometry.computeBoundingSphere();
  }

  /** Give each vertex `size` values. */
  attach(name, values, size) {
    this.geometry.setAttribute(name, new BufferAttribute(values, size));
  }
}

/** Set the normals of vertices, weighted by the area of the faces about them; not of unit length. */
export function setNormals(places, faces, normals) {
  normals.fill(0);
  for (let i = 0; i < faces.length; i += 3) {
    const a = 3 * faces[i];
    const b = 3 * faces[i + 1];
    const c = 3 * faces[i + 2];
    const ux = places[b] - places[a];
    const uy = places[b + 1] - places[a + 1];
    const uz = places[b + 2] - places[a + 2];
    const vx = places[c] - places[a];
    const vy = places[c + 1] - places[a + 1];
    const vz = places[c + 2] - places[a + 2];
    const x = uy * vz - uz * vy;
    const y = uz * vx - ux * vz;
    const z = ux * vy - uy * vx;
    normals[a] += x;
    normals[a + 1] += y;
    normals[a + 2] += z;
    normals[b] += x;
    normals[b + 1] += y;
    normals[b + 2] += z;
    normals[c] += x;
    normals[c + 1] += y;
    normals[c + 2] += z;
  }
}
