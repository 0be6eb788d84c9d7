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

/** The heat map, sRGB at equal steps, ever darker: that of the report's pictures too. */
const HEAT = [
  [0.84, 0.91, 0.94],
  [0.56, 0.79, 0.87],
  [0.97, 0.89, 0.58],
  [0.98, 0.66, 0.32],
  [0.88, 0.33, 0.2],
  [0.55, 0.05, 0.18],
];
const STEPS = 256;

/** Return the heat map, `STEPS` colours of red, green and blue in [0, 1] as screens take them. */
export function heatColours() {
  return Array.from({ length: STEPS }, (_, i) => {
    const at = (i / (STEPS - 1)) * (HEAT.length - 1);
    const step = Math.min(Math.floor(at), HEAT.length - 2);
    return HEAT[step].map((value, d) => value + (at - step) * (HEAT[step + 1][d] - value));
  });
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
