// The skin in the canvas: parts in their colours, or a heat map; solid, translucent, or a net.

import {
  DataTexture, FrontSide, LinearFilter, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  SRGBColorSpace, Vector2,
} from "../../vendor/three.js";
import { heatColours, PARTS, SCAN, UNSEEN } from "./colours.js";
import { partsOf } from "./parts.js";
import { MovingSurface } from "./surface.js";

const ORDER = { depth: 10, skin: 11, scan: 12 };

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

  constructor(neutral, faces) {
    this.surface = new MovingSurface(neutral, faces);
    this.surface.attach("color", colours(partsOf(neutral, faces)), 3);
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
    const planes = plane ? [plane] : null;
    this.#depth.material.clippingPlanes = planes;
    this.material.clippingPlanes = planes;
    this.material.side = plane ? 2 : FrontSide;
    this.material.needsUpdate = true;
    this.#depth.material.needsUpdate = true;
  }
}

/** A scan as a mesh of one colour, to lie over a fit or to stand beside it. */
export class Scan {
  constructor(neutral, faces) {
    this.surface = new MovingSurface(neutral, faces);
    this.material = new MeshStandardMaterial({ roughness: 0.75 });
    this.material.color.setRGB(...SCAN);
    this.mesh = new Mesh(this.surface.geometry, this.material);
    this.mesh.renderOrder = ORDER.scan;
    this.mesh.frustumCulled = false;
  }

  /** Show it `solid`, `clear` (half transparent) or as a `wire` net. */
  setStyle(style) {
    this.material.wireframe = style === "wire";
    this.material.transparent = style !== "solid";
    this.material.opacity = { solid: 1, clear: 0.45, wire: 0.55 }[style];
    this.material.depthWrite = style === "solid";
    this.material.needsUpdate = true;
  }
}

function skinMaterial(uniforms) {
  const material = new MeshStandardMaterial({ vertexColors: true, roughness: 0.62 });
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = `attribute vec2 heat;\nvarying vec2 vHeat;\n${shader.vertexShader}`
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvHeat = heat;");
    shader.fragmentShader = `${HEAT_HEAD}${shader.fragmentShader}`
      .replace("#include <opaque_fragment>", HEAT_BODY);
  };
  return material;
}

const HEAT_HEAD = `
uniform float heatOn;
uniform vec2 heatRange;
uniform sampler2D heatMap;
uniform vec3 unseen;
uniform float clear;
varying vec2 vHeat;
`;

// The colours of the map stay those of the legend: they are shaded only by how far they face away.
const HEAT_BODY = `
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

function colours(parts) {
  const out = new Float32Array(3 * parts.length);
  parts.forEach((part, i) => out.set(PARTS[part], 3 * i));
  return out;
}
