// A description of the canvas in words: for screen readers, and as the picture's caption.

import { plain } from "../words.js";
import { figures } from "./face.js";

/** Return sentences about a state, the `title` and `values` of its heat maps, and its sequence or null. */
export function summary(state, { heats, take }) {
  const sentences = [pose(state, take)];
  for (const heat of heats) {
    const of = figures(heat.values);
    sentences.push(of
      ? `${heat.title}: mean ${of.mean.toFixed(2)} mm, 95th percentile ${of.p95.toFixed(2)} mm, at most ${of.max.toFixed(2)} mm.`
      : `${heat.title}: nothing was seen.`);
  }
  if (state.scan) {
    sentences.push({
      clear: "The scan lies over the fit, half transparent.",
      wire: "The scan lies over the fit as a net.",
      beside: "The scan is at the right of the fit.",
    }[state.scan]);
  }
  if (state.inside) {
    sentences.push(state.muscle
      ? `Muscles and bones show through the skin; ${plain(state.muscle)} stands out.`
      : "Muscles and bones show through the skin.");
  }
  if ((state.inside || state.section) && (take || state.live || state.controls.size)) {
    sentences.push("What is inside stays at rest: only the skin follows.");
  }
  if (state.section) sentences.push(`Cut at ${state.section.axis} = ${state.section.at} mm.`);
  sentences.push(Array.isArray(state.view) ? "The camera was moved by hand." : `Seen from: ${state.view.replace("-", " ")}.`);
  return sentences.join(" ");
}

function pose(state, take) {
  if (state.live) return "The face of a live session.";
  if (take) return `Frame ${state.take.frame + 1} of a sequence, at ${take.times[state.take.frame].toFixed(2)} s.`;
  if (state.controls.size) return `Muscles: ${listed(state.controls)}.`;
  if (state.expressions.size) return `Expressions: ${listed(state.expressions)}.`;
  return "The neutral face.";
}

const MOST_NAMED = 6;

function listed(weights) {
  const strongest = [...weights].sort((a, b) => b[1] - a[1]);
  const named = strongest.slice(0, MOST_NAMED).map(([name, value]) => `${plain(name)} ${Math.round(100 * value)} %`);
  const rest = strongest.length - named.length;
  return named.join(", ") + (rest ? ` and ${rest} more` : "");
}
