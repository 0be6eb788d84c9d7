// The tissue under the skin: flesh that moves with the expressions, muscles in it, and bones.

import {
  DoubleSide, FrontSide, Group, Matrix4, Mesh, MeshPhongMaterial,
} from "../../vendor/three.js";
import { BONE, muscleColours } from "./colours.js";
import { Container } from "./container.js";
import { blend } from "./face.js";
import { MovingSurface } from "./surface.js";

export const NO_MUSCLE = 255;
const PALE = 0.25; // how much colour is left to the muscles that are not chosen

/** What `inside.bin` holds; `group` is to be added to a scene. */
export class Inside {
  #file;
  #chosen = [];

  constructor(buffer) {
    this.#file = new Container(buffer);
    const { bones, muscles } = this.#file.header;
    this.rest = this.#file.array("rest");
    this.tets = this.#file.array("tets");
    this.mainMuscle = this.#file.array("main_muscle");
    this.x = new Float32Array(this.rest);
    this.names = muscles;
    this.colours = muscleColours(muscles);
    this.muscles = muscles.map((name, number) => this.#muscle(name, number));
    this.bones = bones.map((bone, number) => this.#bone(bone, number));
    this.group = new Group();
    this.group.add(...this.bones.map((bone) => bone.mesh), ...this.muscles.map((muscle) => muscle.mesh));
    this.setWeights([]);
  }

  /** Whether the flesh of expression `k` is known; if not, it stays at rest. */
  knows(k) {
    return this.#file.has(`at/${k}`);
  }

  /** Take the pose of expressions by their weights. Places and the jaw's motion are blended alike. */
  setWeights(weights) {
    blend(this.x, this.rest, weights, (k) => (this.knows(k) ? this.#file.array(`at/${k}`) : null));
    const jaw = jawMotion(weights, this.#file.array("jaw"));
    for (const muscle of this.muscles) this.#carry(muscle);
    for (const bone of this.bones) {
      if (bone.movesWith === "jaw") bone.mesh.matrix.copy(jaw);
      bone.mesh.matrixWorldNeedsUpdate = true;
    }
    this.jaw = jaw;
  }

  /** Make muscles, by their names, stand out; without any, none is pale. */
  choose(names) {
    this.#chosen = names;
    for (const muscle of this.muscles) {
      const isChosen = names.includes(muscle.name);
      const share = names.length && !isChosen ? PALE : 1;
      muscle.mesh.material.color.setRGB(...this.colours.get(muscle.name).map((value) => share * value + (1 - share) * 0.5));
      muscle.mesh.material.emissive.setRGB(...this.colours.get(muscle.name).map((value) => (isChosen ? 0.35 * value : 0)));
      muscle.mesh.material.opacity = share < 1 ? 0.35 : 1;
      muscle.mesh.material.transparent = share < 1;
      muscle.mesh.material.depthWrite = share === 1;
      muscle.mesh.material.needsUpdate = true;
    }
  }

  get chosen() {
    return this.#chosen;
  }

  /** Cut away what lies on the far side of a plane; null is whole. */
  setClip(plane) {
    for (const { mesh } of [...this.muscles, ...this.bones]) {
      mesh.material.clippingPlanes = plane ? [plane] : null;
      mesh.material.side = plane ? DoubleSide : FrontSide;
      mesh.material.needsUpdate = true;
    }
  }

  #muscle(name, number) {
    const place = `muscle/${number}`;
    const rest = this.#file.array(`${place}/vertices`);
    const surface = new MovingSurface(rest, this.#file.array(`${place}/faces`));
    const material = new MeshPhongMaterial({ specular: "#1c1c1c", shininess: 18 });
    material.color.setRGB(...this.colours.get(name));
    const mesh = new Mesh(surface.geometry, material);
    mesh.name = name;
    return {
      name, rest, surface, mesh, tet: this.#file.array(`${place}/tet`), weights: this.#file.array(`${place}/weights`),
    };
  }

  #bone({ name, moves_with: movesWith }, number) {
    const place = `bone/${number}`;
    const faces = this.#file.array(`${place}/faces`);
    const surface = new MovingSurface(this.#file.array(`${place}/vertices`), faces);
    const material = new MeshPhongMaterial({ specular: "#1c1c1c", shininess: 18 });
    material.color.setRGB(...BONE);
    const mesh = new Mesh(surface.geometry, material);
    mesh.name = name;
    mesh.matrixAutoUpdate = false;
    return { name, movesWith, surface, faces, mesh };
  }

  /** Move a muscle's surface as the tets that it lies in have moved. */
  #carry({ surface, rest, tet, weights }) {
    const { places } = surface;
    const { tets } = this;
    for (let i = 0; i < tet.length; i++) {
      for (let d = 0; d < 3; d++) {
        let way = 0;
        for (let corner = 0; corner < 4; corner++) {
          const at = 3 * tets[4 * tet[i] + corner] + d;
          way += weights[4 * i + corner] * (this.x[at] - this.rest[at]);
        }
        places[3 * i + d] = rest[3 * i + d] + way;
      }
    }
    surface.moved();
  }
}

/** Return the jaw's motion for weights of expressions; `motions` are theirs, row by row. */
function jawMotion(weights, motions) {
  const entries = new Matrix4().identity().transpose().toArray();
  const unit = [...entries];
  weights.forEach((weight, k) => {
    if (weight) for (let i = 0; i < 16; i++) entries[i] += weight * (motions[16 * k + i] - unit[i]);
  });
  return new Matrix4().set(...entries);
}
