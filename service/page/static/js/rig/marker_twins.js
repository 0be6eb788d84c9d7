// Markers of both sides of a face that belong together.

const WORDS = [["left", "right"], ["l", "r"]];
const FAR_MM = 12; // off its twin's mirror image a marker without a name for its side is no twin
const MIDDLE_MM = 6; // a marker so near to its own mirror image has none

/**
 * Return for each marker the number of its twin, -1 without one: the label that says the other side in the
 * same words, else the marker that is nearest to the mirror image of its place.
 */
export function twins(labels, places, mirrored) {
  const numbers = new Map(labels.map((label, k) => [label.toLowerCase(), k]));
  const named = labels.map((label, k) => (
    otherSides(label.toLowerCase()).map((other) => numbers.get(other) ?? -1).find((each) => each >= 0 && each !== k) ?? -1
  ));
  return named.map((twin, k) => {
    if (twin >= 0) return twin;
    const image = mirrored(places[k]);
    if (apart(image, places[k]) < MIDDLE_MM) return -1;
    const away = places.map((place, i) => (i === k || named[i] >= 0 ? Infinity : apart(place, image)));
    const least = Math.min(...away);
    return least < FAR_MM ? away.indexOf(least) : -1;
  });
}

/** Return a label with one word or letter of a side changed to the other, each in turn. */
function otherSides(label) {
  return WORDS.flatMap(([left, right]) => [[left, right], [right, left]].flatMap(([from, to]) => {
    const found = [];
    for (let at = label.indexOf(from); at >= 0; at = label.indexOf(from, at + 1)) {
      found.push(label.slice(0, at) + to + label.slice(at + from.length));
    }
    return found;
  }));
}

function apart(a, b) {
  return Math.hypot(...a.map((each, d) => each - b[d]));
}
