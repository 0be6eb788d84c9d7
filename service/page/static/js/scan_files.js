// What a dropped set of files is: which are scans, what they are called, which is the neutral.

const NEUTRAL = /(^|[^a-z])(neutral|neutre|rest|relaxed)([^a-z]|$)/i;
const LANDMARKS = /[ _.-]*(landmarks?|lm)$/i;
const PERFORMANCE = ".npy";
const LONGEST_NAME = 64;

/** What the API takes as a name. */
export const NAME = "[A-Za-z0-9][A-Za-z0-9_.\\-]{0,63}";

/** Return the files of a drop, those in folders too. */
export async function dropped(transfer) {
  // entries must be taken before the first wait: the list is empty afterwards
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  return (await Promise.all(entries.map(filesIn))).flat();
}

async function filesIn(entry) {
  if (entry.isFile) return [await new Promise((resolve, reject) => entry.file(resolve, reject))];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) break;
    found.push(...some);
  }
  return (await Promise.all(found.map(filesIn))).flat();
}

/**
 * Sort files into `scans` ({file, name, role, landmarks}) and `others`, which are no scans.
 *
 * Landmarks go with the scan that has their name. The neutral is the one that is called so, and
 * comes first.
 */
export function sorted(files, limits) {
  const isScan = (file) => [...limits.raw_scan_formats, PERFORMANCE].includes(suffix(file));
  const isLandmarks = (file) => limits.landmark_formats.includes(suffix(file));
  const meshes = files.filter((file) => isScan(file) && !isLandmarks(file));
  const stems = new Set(meshes.map(stem));
  // a .csv may hold either: landmarks if a scan has its name or it says so itself
  const landmarks = files.filter(
    (file) => isLandmarks(file) && (!isScan(file) || LANDMARKS.test(stem(file)) || stems.has(stem(file))),
  );
  const scans = files.filter((file) => isScan(file) && !landmarks.includes(file));
  const names = withoutCommonPart(scans.map(stem));
  const of = (file) => landmarks.find((other) => stem(other).replace(LANDMARKS, "") === stem(file)) ?? null;
  const found = scans.map((file, i) => ({
    file,
    name: asName(names[i]),
    role: roleOf(file),
    landmarks: of(file),
  }));
  const taken = new Set(found.flatMap(({ file, landmarks: its }) => [file, its]));
  found.sort((a, b) => (b.role === "neutral") - (a.role === "neutral") || a.name.localeCompare(b.name));
  return { scans: found, others: files.filter((file) => !taken.has(file)) };
}

function roleOf(file) {
  if (suffix(file) === PERFORMANCE) return "performance";
  return NEUTRAL.test(stem(file)) ? "neutral" : "expression";
}

/** Cut what all names begin with up to a `_` or `-`: the person, the session. */
function withoutCommonPart(names) {
  if (names.length < 2) return names;
  let length = 0;
  while (length < names[0].length && names.every((name) => name[length] === names[0][length])) length++;
  const part = /^.*[ _-]/.exec(names[0].slice(0, length));
  return names.map((name) => name.slice(part?.[0].length ?? 0) || name);
}

function asName(text) {
  const plain = text.normalize("NFKD").replace(/[\u0300-\u036f]/g, "");
  const name = plain.replace(/[^A-Za-z0-9_.-]+/g, "_").replace(/^[^A-Za-z0-9]+|_+$/g, "");
  return (name || "scan").slice(0, LONGEST_NAME);
}

function suffix({ name }) {
  const dot = name.lastIndexOf(".");
  return dot > 0 ? name.slice(dot).toLowerCase() : "";
}

function stem(file) {
  return file.name.slice(0, file.name.length - suffix(file).length);
}
