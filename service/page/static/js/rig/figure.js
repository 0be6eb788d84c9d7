// One rig in the canvas: its skin, the scan over it or beside it, what is inside, and a section.

import { distances } from "./face.js";
import { occlusion } from "./occlusion.js";
import { Section } from "./section.js";
import { Scan, Skin } from "./skin.js";

/** Draws a face into a pane of a stage; places are flat x, y, z in mm. */
export class Figure {
  #stage;
  #face;
  #scan = null;
  #section = null;
  #cut = null;

  constructor(stage, face, pane = 0) {
    this.#stage = stage;
    this.#face = face;
    this.pane = pane;
    this.skin = new Skin(face.neutral, face.faces);
    this.inside = null;
    stage.panes[pane].add(this.skin.mesh);
  }

  /** Shade hollows, once that is worked out. */
  async shade(signal) {
    const { geometry } = this.skin.surface;
    const normals = geometry.attributes.normal.array.slice();
    this.skin.setLight(await occlusion(this.#face.neutral, geometry.index.array, normals, signal));
    this.#stage.invalidate();
  }

  /** Corners of the box about the neutral. */
  get box() {
    return box(this.#face.neutral);
  }

  /** Return the places of the skin, to be set by whoever then calls `moved`. */
  get places() {
    return this.skin.surface.places;
  }

  /** Take note of new places. */
  moved() {
    this.skin.surface.moved();
    if (this.#cut) this.#slice();
    this.#stage.invalidate();
  }

  /** Return how far each vertex is off its place in the neutral. */
  motion() {
    return distances(this.places, this.#face.neutral);
  }

  /** Show the scan: `clear` or `wire` over the skin, `beside` it, or null; `places` are the scan's. */
  setScan(style, places) {
    if (!style || !places) {
      this.#scan?.mesh.removeFromParent();
      return;
    }
    this.#scan ??= new Scan(this.#face.neutral, this.#face.faces, this.skin.surface.geometry.index.array, this.skin.rim);
    const pane = style === "beside" ? this.pane + 1 : this.pane;
    this.#stage.panes[pane].add(this.#scan.mesh);
    this.#scan.setStyle(style === "beside" ? "solid" : style);
    this.#scan.surface.places.set(places);
    this.#scan.surface.moved();
  }

  /** Show what is inside, or not, and cut at `cut.at` mm along `cut.axis`, null for no cut. */
  showInside(inside, isShown, cut) {
    if (this.inside !== inside) {
      this.inside = inside;
      this.#stage.panes[this.pane].add(inside.group);
    }
    inside.group.visible = isShown || cut !== null;
    this.skin.setClear(isShown && !cut);
    if (cut) {
      this.#section ??= new Section();
      this.#section.turnTo(cut.axis, cut.at, this.#stage.camera);
      this.#stage.panes[this.pane].add(this.#section.group);
    } else this.#section?.group.removeFromParent();
    if (Boolean(cut) !== Boolean(this.#cut)) {
      this.skin.setClip(cut && this.#section.plane);
      inside.setClip(cut && this.#section.plane);
    }
    this.#cut = cut;
  }

  /** Return what is under the pointer inside the skin: its `name` and whether it `isMuscle`; or null. */
  pick(event) {
    if (!this.inside?.group.visible) return null;
    const muscles = this.inside.muscles.map(({ mesh }) => mesh);
    const bones = this.inside.bones.map(({ mesh }) => mesh);
    const plane = this.#cut ? this.#section.plane : null;
    const [found] = this.#stage.pick(event, [...muscles, ...bones])
      .filter(({ point }) => !plane || plane.distanceToPoint(point) >= 0);
    return found ? { name: found.object.name, isMuscle: muscles.includes(found.object) } : null;
  }

  /** Turn the cut towards the camera, if it has gone round to the other side. */
  faceCamera() {
    if (this.#cut) this.#section.turnTo(this.#cut.axis, this.#cut.at, this.#stage.camera);
  }

  #slice() {
    const outlines = this.inside.bones.map(({ surface, mesh, faces }) => [
      surface.places, faces, mesh.matrix,
    ]);
    outlines.push([this.places, this.#face.faces, null]);
    this.#section.cut(this.#cut.axis, this.#cut.at, this.inside, outlines);
  }
}

/** Return the least and the greatest x, y, z of places. */
export function box(places) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < places.length; i++) {
    const d = i % 3;
    if (places[i] < low[d]) low[d] = places[i];
    if (places[i] > high[d]) high[d] = places[i];
  }
  return [low, high];
}
