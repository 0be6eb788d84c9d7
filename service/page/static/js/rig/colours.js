// Colours of faces, muscles and millimetres.

import { withoutSide } from "./preview.js";

/** Of the parts of a face, linear, as in the pictures of the report. */
export const PARTS = {
  skin: [0.62, 0.43, 0.34],
  eyes: [0.74, 0.72, 0.69],
  teeth: [0.72, 0.66, 0.54],
  mouth: [0.45, 0.16, 0.15],
  lashes: [0, 0, 0],
};
export const IRIS = [0.1, 0.16, 0.17];
export const PUPIL = [0.008, 0.008, 0.01];
export const IRIS_MM = 6; // radii; an adult iris is 11.7 mm across (Rüfer et al. 2005)
export const PUPIL_MM = 2.4;
export const BONE = [0.72, 0.64, 0.5];
export const SCAN = [0.42, 0.5, 0.58];
export const NET = [0.02, 0.1, 0.22];
export const UNSEEN = [0.6, 0.6, 0.61];
export const FLESH = [0.86, 0.68, 0.42];

const STEPS = 256;

/**
 * Return the heat map, `STEPS` colours of red, green and blue in [0, 1] as screens take them.
 *
 * From pale yellow to dark wine red, evenly spaced in OKLab: equal steps in millimetres look equal,
 * lightness falls all the way, so that it reads in grey and for the colour blind too.
 */
export function heatColours() {
  const fine = Array.from({ length: 4 * STEPS }, (_, i) => oklab(i / (4 * STEPS - 1)));
  const along = [0];
  for (let i = 1; i < fine.length; i++) {
    along.push(along[i - 1] + Math.hypot(...fine[i].map((value, d) => value - fine[i - 1][d])));
  }
  let at = 0;
  return Array.from({ length: STEPS }, (_, i) => {
    const length = (i / (STEPS - 1)) * along.at(-1);
    while (at < along.length - 2 && along[at + 1] < length) at++;
    const share = (length - along[at]) / (along[at + 1] - along[at]);
    return srgb(fine[at].map((value, d) => value + share * (fine[at + 1][d] - value)));
  });
}

function oklab(share) {
  const lightness = 0.96 - 0.66 * share;
  const chroma = 0.055 + 0.11 * Math.sin(Math.PI * Math.min(1, 0.12 + 0.74 * share));
  const hue = ((108 - 96 * share ** 0.85) * Math.PI) / 180;
  return [lightness, chroma * Math.cos(hue), chroma * Math.sin(hue)];
}

/** Return OKLab as sRGB (Ottosson 2020). */
function srgb([lightness, a, b]) {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map((value) => encoded(Math.min(1, Math.max(0, value))));
}

function encoded(linear) {
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}

/**
 * Return muscle -> linear colour: hues by the golden ratio, so that neighbours in the list differ;
 * the two sides of a muscle share one.
 */
export function muscleColours(names) {
  const kinds = [...new Set(names.map(withoutSide))];
  return new Map(names.map((name) => {
    const number = kinds.indexOf(withoutSide(name));
    const hue = (0.985 + number * 0.381966) % 1;
    return [name, linearOf(hue, [0.4, 0.56, 0.48, 0.66][number % 4], 0.58)];
  }));
}

function linearOf(hue, lightness, saturation) {
  const strength = saturation * Math.min(lightness, 1 - lightness);
  return [0, 8, 4].map((n) => {
    const k = (n + hue * 12) % 12;
    return (lightness - strength * Math.max(-1, Math.min(k - 3, 9 - k, 1))) ** 2.2;
  });
}
