// Which kinds of job are offered beside a rig or for a person without one, by what they read.

/** Return the kinds of job that need nothing but a rig and, maybe, assets; sessions begin at a station. */
export function kindsOfRigs(kinds) {
  const needless = ({ reads }) => !["captures", "performance", "markers", "photos"].some((each) => reads.includes(each));
  return [...kinds.values()].filter((kind) => kind.reads.includes("rig") && kind.queue !== "live" && needless(kind));
}

/** Return the kinds of job that fit chosen expressions with a rig. */
export function kindsOfFits(kinds) {
  return [...kinds.values()].filter(({ reads }) => ["rig", "captures"].every((each) => reads.includes(each)));
}

/** Return the kinds of job that fit a rig, or the model without one, to chosen photographs. */
export function kindsOfPhotos(kinds) {
  return [...kinds.values()].filter(({ reads }) => ["any_rig", "photos"].every((each) => reads.includes(each)));
}

/** Return the kinds of job that need chosen photographs alone. */
export function kindsOfEstimates(kinds) {
  return [...kinds.values()].filter(({ reads }) => reads.includes("photos") && !reads.includes("any_rig"));
}

/** Return why no job can have the chosen photographs of some captures, or not yet; null if one can. */
export function whyNoPhotos(captures, chosen, whyNotYet = null) {
  if (!captures.some(({ role }) => role === "photo")) return "Upload photographs first";
  return whyNotYet ?? (chosen.length ? null : "Choose photographs in the list of scans first");
}
