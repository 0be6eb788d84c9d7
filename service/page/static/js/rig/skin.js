// The skin in the canvas: parts in their colours, or a heat map; solid, translucent, or a net.

import {
  DataTexture, DoubleSide, FrontSide, LinearFilter, Mesh, MeshBasicMaterial, MeshPhongMaterial,
  ShaderChunk, SRGBColorSpace, Vector2,
} from "../../vendor/three.js";
import { heatColours, IRIS, IRIS_MM, NET, PARTS, PUPIL, PUPIL_MM, SCAN, UNSEEN } from "./colours.js";
import { partsOf } from "./parts.js";
import { rimPlane } from "./rim.js";
import { MovingSurface } from "./surface.js";

const ORDER = { depth: 10, skin: 11, scan: 12 };
const LEAST_LIGHT = { teeth: 0.55, mouth: 0.4 }; // hollows are those of the neutral, whose mouth is closed

/** A face as a mesh; `mesh` is to be added to a scene. */
export class Skin {
  #heat;
  #uniforms = {
    heatOn: { value: 0 },
    heatRange: { value: new Vector2(0, 2) },
    heatMap: { value: heatTexture() },
    unseen: { value: UNSEEN },
    clear: { value: 0 },
  };
  #depth;
  #parts;

  constructor(neutral, faces) {
    const parts = partsOf(neutral, faces);
    this.#parts = parts.names;
    /** Where the neck is cut, null if nowhere. */
    this.rim = rimPlane(neutral, faces.filter((_, i) => parts.names[faces[i - (i % 3)]] === "skin"));
    this.surface = new MovingSurface(neutral, faces, withoutLashes(faces, parts.names));
    this.surface.attach("color", colours(parts.names), 3);
    this.surface.attach("eye", eyes(parts.eyes, neutral), 3);
    this.surface.attach("lit", new Float32Array(neutral.length / 3).fill(1), 1);
    this.#heat = new Float32Array((2 * neutral.length) / 3);
    this.surface.attach("heat", this.#heat, 2);
    this.material = skinMaterial(this.#uniforms);
    this.mesh = new Mesh(this.surface.geometry, this.material);
    this.mesh.renderOrder = ORDER.skin;
    this.mesh.frustumCulled = false;
    // a translucent skin must hide its own far side: its depth is laid down before its colour
    this.#depth = new Mesh(this.surface.geometry, new MeshBasicMaterial({ colorWrite: false, transparent: true, side: FrontSide }));
    this.#depth.renderOrder = ORDER.depth;
    this.#depth.visible = false;
    this.#depth.frustumCulled = false;
    this.mesh.add(this.#depth);
    this.setClip(null);
  }

  /** Set the share of light that reaches each vertex. */
  setLight(shares) {
    const { array } = this.surface.geometry.attributes.lit;
    this.#parts.forEach((part, i) => { array[i] = Math.max(shares[i], LEAST_LIGHT[part] ?? 0); });
    this.surface.geometry.attributes.lit.needsUpdate = true;
  }

  /** Colour by `values` per vertex, mm, NaN grey; null shows the skin. */
  setHeat(values) {
    this.#uniforms.heatOn.value = values ? 1 : 0;
    if (!values) return;
    for (let i = 0; i < values.length; i++) {
      const known = Number.isFinite(values[i]);
      this.#heat[2 * i] = known ? values[i] : 0;
      this.#heat[2 * i + 1] = known ? 1 : 0;
    }
    this.surface.geometry.attributes.heat.needsUpdate = true;
  }

  /** Set which millimetres have the first and the last colour. */
  setRange(low, high) {
    this.#uniforms.heatRange.value.set(low, high);
  }

  /** Let what is inside shine through. */
  setClear(isClear) {
    this.#uniforms.clear.value = isClear ? 1 : 0;
    this.#depth.visible = isClear;
    this.material.transparent = isClear;
    this.material.needsUpdate = true;
  }

  /** Cut away what lies on the far side of a plane; null is whole. */
  setClip(plane) {
    const planes = [plane, this.rim].filter(Boolean);
    this.#depth.material.clippingPlanes = planes;
    this.material.clippingPlanes = planes;
    this.material.side = plane ? DoubleSide : FrontSide;
    this.material.needsUpdate = true;
    this.#depth.material.needsUpdate = true;
  }
}

/** A scan as a mesh of one colour, to lie over a fit or to stand beside it. */
export class Scan {
  /** `drawn` are those of the faces that are drawn; `rim` is the plane that cuts the neck, or null. */
  constructor(neutral, faces, drawn, rim) {
    this.surface = new MovingSurface(neutral, faces, drawn);
    this.material = new MeshPhongMaterial({
      specular: "#1c1c1c", shininess: 18, clippingPlanes: rim ? [rim] : [],
    });
    this.mesh = new Mesh(this.surface.geometry, this.material);
    this.mesh.renderOrder = ORDER.scan;
    this.mesh.frustumCulled = false;
  }

  /** Show it `solid`, `clear` (half transparent) or as a `wire` net. */
  setStyle(style) {
    this.material.wireframe = style === "wire";
    this.material.transparent = style !== "solid";
    this.material.opacity = { solid: 1, clear: 0.5, wire: 0.4 }[style];
    this.material.color.setRGB(...(style === "wire" ? NET : SCAN));
    this.material.depthWrite = style === "solid";
    this.material.needsUpdate = true;
  }
}

function skinMaterial(uniforms) {
  const material = new MeshPhongMaterial({ vertexColors: true, specular: "#2b2826", shininess: 22 });
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = `${VERTEX_HEAD}${shader.vertexShader}`
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvHeat = heat;\nvEye = eye;\nvLit = lit;");
    shader.fragmentShader = `${FRAGMENT_HEAD}${shader.fragmentShader}`
      .replace("#include <color_fragment>", `#include <color_fragment>${EYE}`)
      .replace("#include <lights_phong_pars_fragment>", SOFT_LIGHT)
      .replace("#include <opaque_fragment>", HEAT);
  };
  return material;
}

const VERTEX_HEAD = `
attribute vec2 heat;
attribute vec3 eye;
attribute float lit;
varying float vLit;
varying vec2 vHeat;
varying vec3 vEye;
`;

const FRAGMENT_HEAD = `
uniform float heatOn;
uniform vec2 heatRange;
uniform sampler2D heatMap;
uniform vec3 unseen;
uniform float clear;
varying float vLit;
varying vec2 vHeat;
varying vec3 vEye;
`;

// An iris on the front of an eyeball, whatever its mesh.
const EYE = `
if (vEye.z > 0.0) {
  float off = length(vEye.xy);
  float ring = smoothstep(${IRIS_MM.toFixed(1)}, ${(IRIS_MM - 0.7).toFixed(1)}, off);
  float hole = smoothstep(${PUPIL_MM.toFixed(1)}, ${(PUPIL_MM - 0.4).toFixed(1)}, off);
  diffuseColor.rgb = mix(mix(diffuseColor.rgb, vec3(${IRIS.join(", ")}), ring), vec3(${PUPIL.join(", ")}), hole);
}
`;

// Light wanders a little under skin, red the furthest: shadows begin later there and are warm.
const HARD = "dotNL * directLight.color";
const SOFT = "saturate((dot(geometryNormal, directLight.direction) + WANDER) / (1.0 + WANDER)) * directLight.color";
const SOFT_LIGHT = `const vec3 WANDER = vec3(0.32, 0.13, 0.09);
${ShaderChunk.lights_phong_pars_fragment.replace(HARD, SOFT)}`;

// The colours of the map stay those of the legend: they are shaded only by how far they face away.
const HEAT = `
outgoingLight *= pow(vec3(mix(0.06, 1.0, vLit)), vec3(0.75, 1.0, 1.1)); // what is left in hollows is red
float facing = abs(dot(normalize(normal), normalize(vViewPosition)));
if (heatOn > 0.5) {
  float share = clamp((vHeat.x - heatRange.x) / max(heatRange.y - heatRange.x, 1e-6), 0.0, 1.0);
  vec3 seen = texture2D(heatMap, vec2(share * 255.0 / 256.0 + 0.5 / 256.0, 0.5)).rgb;
  outgoingLight = (vHeat.y > 0.999 ? seen : unseen) * (0.62 + 0.38 * facing);
}
diffuseColor.a = mix(1.0, mix(0.75, 0.13, smoothstep(0.0, 0.75, facing)), clear);
#include <opaque_fragment>
`;

function heatTexture() {
  const colours = heatColours();
  const data = new Uint8Array(colours.flatMap((colour) => [...colour.map((value) => Math.round(255 * value)), 255]));
  const texture = new DataTexture(data, colours.length, 1);
  texture.colorSpace = SRGBColorSpace;
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

function colours(names) {
  const out = new Float32Array(3 * names.length);
  names.forEach((part, i) => out.set(PARTS[part], 3 * i));
  return out;
}

/** Return for each vertex of an eyeball how it lies off its centre, mm; zero for others. */
function eyes(balls, places) {
  const out = new Float32Array(places.length);
  for (const { centre, vertices } of balls) {
    for (const vertex of vertices) {
      for (let d = 0; d < 3; d++) out[3 * vertex + d] = places[3 * vertex + d] - centre[d];
    }
  }
  return out;
}

/** Return the faces without lashes and tear film: opaque they would cover the eyes. */
function withoutLashes(faces, names) {
  const drawn = faces.filter((_, i) => names[faces[i - (i % 3)]] !== "lashes");
  return drawn.length ? drawn : faces;
}
