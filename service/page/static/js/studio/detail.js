// What a skin has beyond its mesh: the neutral's normal map, and wrinkles that the weights of shapes bring.
//
//     s = min(max(sum w c, 0) / sum c c, 1),    normal = normalize(n.xy / n.z + sum s m e.xy / e.z, 1)
//
// c are the weights that an expression is made of, m and e the opacity and the normal of its map, whose z
// counts as LEAST_UP at least, and n the neutral's normal.

import { DataTexture, ShaderChunk } from "../../vendor/three.js";

const MOST = 8; // maps: a shader has 16 images
const LEAST_UP = "0.1";
const FLAT = new Uint8Array([128, 128, 255, 255]); // the normal of a mesh alone
const CHUNK = "#include <normal_fragment_maps>";
const SCALED = "mapN.xy *= normalScale;";

/** The detail on a `material`; `maps` are `{ name, drivenBy, texture }`, of which the eight strongest are shown. */
export class SkinDetail {
  #maps;
  #slots; // what the shader has: the maps that are strongest at the moment
  #own = { value: 1 };
  #isOn = true;
  #weights = new Map();

  constructor(material, maps) {
    this.#maps = maps.map((map) => ({ ...map, strength: 0 }));
    this.#slots = maps.slice(0, MOST).map(({ texture }) => ({ texture: { value: texture }, strength: { value: 0 } }));
    if (!material.normalMap) {
      if (!maps.length) return;
      material.normalMap = new DataTexture(FLAT, 1, 1);
      material.normalMap.needsUpdate = true;
      material.normalScale.set(1, -1); // without tangents v runs downwards
    }
    material.onBeforeCompile = (shader) => this.#mix(shader);
    material.needsUpdate = true;
  }

  /** How strong the wrinkles of each expression are, by name. */
  get strengths() {
    return new Map(this.#maps.map(({ name, strength }) => [name, strength]));
  }

  /** Show the neutral's detail or none. */
  setNormals(isOn) {
    this.#own.value = isOn ? 1 : 0;
  }

  /** Show wrinkles or none. */
  setWrinkles(isOn) {
    this.#isOn = isOn;
    this.pose(this.#weights);
  }

  /** Bring the wrinkles of shapes with these weights. */
  pose(weights) {
    this.#weights = weights;
    for (const map of this.#maps) {
      const made = Object.entries(map.drivenBy);
      const along = made.reduce((sum, [name, c]) => sum + c * (weights.get(name) ?? 0), 0);
      const whole = made.reduce((sum, [, c]) => sum + c * c, 0);
      map.strength = this.#isOn ? Math.min(Math.max(along, 0) / whole, 1) : 0;
    }
    const strongest = [...this.#maps].sort((a, b) => b.strength - a.strength);
    this.#slots.forEach(({ texture, strength }, i) => {
      texture.value = strongest[i].texture;
      strength.value = strongest[i].strength;
    });
  }

  #mix(shader) {
    shader.uniforms.ownDetail = this.#own;
    this.#slots.forEach(({ texture, strength }, i) => {
      shader.uniforms[`wrinkles${i}`] = texture;
      shader.uniforms[`strength${i}`] = strength;
    });
    const declared = this.#slots.map((_, i) => `uniform sampler2D wrinkles${i};\nuniform float strength${i};\n`);
    const added = this.#slots.map((_, i) => `{
      vec4 map = texture2D(wrinkles${i}, vNormalMapUv);
      vec3 e = 2.0 * map.xyz - 1.0;
      slopes += strength${i} * map.a * normalScale * e.xy / max(e.z, ${LEAST_UP});
    }`);
    const mixed = `${SCALED}
    vec2 slopes = ownDetail * mapN.xy / mapN.z;
    ${added.join("\n")}
    mapN = normalize(vec3(slopes, 1.0));`;
    shader.fragmentShader = `uniform float ownDetail;\n${declared.join("")}${shader.fragmentShader}`
      .replace(CHUNK, ShaderChunk.normal_fragment_maps.replace(SCALED, mixed));
  }
}
