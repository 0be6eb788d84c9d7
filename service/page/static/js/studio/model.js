// A studio's rig (`studio.glb`) in the canvas: shapes by weights, joints, and the skin's images.

import { Color, GLTFLoader, TextureLoader, Vector3 } from "../../vendor/three.js";
import { box } from "../rig/figure.js";
import { MM } from "../rig/glb.js";
import { rimPlane } from "../rig/rim.js";
import { SkinDetail } from "./detail.js";

const RADIANS = Math.PI / 180;
const SKIN = "skin"; // the node's name
const HALF = "_half"; // ends the name of a shape that is added half way into another one
const CLAY = new Color(0.67, 0.4, 0.3); // of a skin without colours

/** A rig to be added to a scene as `root`; `told` is what its studio.json says. */
export class StudioModel {
  #told;
  #meshes = [];
  #joints = new Map();
  #skin;
  #places;
  #colours;

  /** Read a GLB; `maps` are the wrinkles' images, name -> blob. */
  static async read(buffer, told, maps) {
    const loader = new GLTFLoader();
    loader.register((parser) => {
      // images as elements: the page's policy lets these show what is in memory
      parser.textureLoader = new TextureLoader(parser.options.manager);
      return { name: "images" };
    });
    const { scene } = await loader.parseAsync(buffer, "");
    const wrinkles = await Promise.all([...maps].map(async ([name, blob]) => (
      { name, drivenBy: told.wrinkles[name].driven_by, texture: await textureOf(blob) }
    )));
    return new StudioModel(scene, told, wrinkles);
  }

  constructor(scene, told, wrinkles) {
    this.#told = told;
    this.root = scene;
    scene.scale.setScalar(MM);
    scene.traverse((object) => {
      const { name } = object.userData;
      if (object.isBone) this.#joints.set(name, { bone: object, rest: object.position.clone() });
      if (!object.isMesh) return;
      object.frustumCulled = false; // shapes leave the neutral's box
      this.#meshes.push(object);
      if (name === SKIN) this.#skin = object;
    });
    const { material, geometry } = this.#skin;
    this.#colours = material.map;
    this.#places = geometry.attributes.position.array.map((value) => MM * value);
    const rim = rimPlane(this.#places, welded(this.#places, geometry.index.array));
    material.clippingPlanes = rim ? [rim] : [];
    /** Whether the skin has colours, a normal map, and wrinkles. */
    this.has = {
      colours: material.map !== null,
      normals: material.normalMap !== null,
      wrinkles: wrinkles.length > 0 && Boolean(geometry.attributes.uv),
    };
    this.detail = new SkinDetail(material, this.has.wrinkles ? wrinkles : []);
    /** The shapes' names. */
    this.names = Object.keys(told.shapes);
  }

  /** Corners of the skin at rest, mm. */
  get box() {
    return box(this.#places);
  }

  /** Show shapes by their weights, name -> 0 to 1. */
  pose(weights) {
    for (const { morphTargetDictionary: numbers = {}, morphTargetInfluences: values } of this.#meshes) {
      for (const [name, number] of Object.entries(numbers)) values[number] = share(name, weights);
    }
    for (const [joint, { bone, rest }] of this.#joints) {
      const turn = new Vector3();
      const shift = new Vector3();
      for (const [name, weight] of weights) {
        const moved = this.#told.shapes[name]?.joints?.[joint];
        if (!moved) continue;
        turn.addScaledVector(new Vector3(...moved.turn_deg), weight * RADIANS);
        shift.addScaledVector(new Vector3(...moved.move_mm), weight / MM);
      }
      const angle = turn.length();
      bone.quaternion.setFromAxisAngle(angle ? turn.divideScalar(angle) : turn.set(1, 0, 0), angle);
      bone.position.copy(rest).add(shift);
    }
    this.detail.pose(weights);
  }

  /** Show the person's colours, or the skin in one. */
  setColours(isOn) {
    const { material } = this.#skin;
    material.map = isOn ? this.#colours : null;
    if (isOn) material.color.set("white");
    else material.color.copy(CLAY);
    material.needsUpdate = true;
  }
}

/** Return the weight of a morph target: a shape's own, or 4 w (1 - w) of what is added half way. */
function share(name, weights) {
  if (!name.endsWith(HALF)) return weights.get(name) ?? 0;
  const own = weights.get(name.slice(0, -HALF.length)) ?? 0;
  return 4 * own * (1 - own);
}

/** Return faces by the first vertex at each place: the texture's seams have several. */
function welded(places, faces) {
  const first = new Map();
  return faces.map((vertex) => {
    const place = places.slice(3 * vertex, 3 * vertex + 3).join();
    if (!first.has(place)) first.set(place, vertex);
    return first.get(place);
  });
}

async function textureOf(blob) {
  const url = URL.createObjectURL(blob);
  try {
    const texture = await new TextureLoader().loadAsync(url);
    texture.flipY = false; // as in glTF
    return texture;
  } finally {
    URL.revokeObjectURL(url);
  }
}
