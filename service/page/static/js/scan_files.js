// Sort a dropped set of files: which are scans, what they are called, which is the neutral.

const NEUTRAL = ["neutral", "neutre", "rest", "relaxed"];
// letters that are none with an accent
const LETTERS = { ß: "ss", æ: "ae", Æ: "AE", œ: "oe", Œ: "OE", ø: "o", Ø: "O", ł: "l", Ł: "L" };
const LANDMARKS = /[ _.-]*(landmarks?|lm)$/i;
const DEVICES = /^(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)/i; // Windows keeps these names
const LONGEST_NAME = 64;
const LONGEST_HEADER = 1 << 14;
const [NEW_LINE, V, BLANK, TAB] = [..."\nv \t"].map((letter) => letter.charCodeAt(0));
const LEGAL = /^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$/;

/** Whether a capture says where markers sit, and is no take of them. */
export function isMarkerSet({ role, filename }) {
  return role === "markers" && filename.toLowerCase().endsWith(".json");
}

/** What the API takes as a name. */
export const NAME = "[A-Za-z0-9][A-Za-z0-9_.\\-]{0,63}";

const folders = new WeakMap(); // of dropped files

/** Return which of `files` lie in the folder of a scan. */
export function beside(scan, files) {
  const folder = folderOf(scan);
  return files.filter((file) => file !== scan && folderOf(file) === folder);
}

function folderOf(file) {
  const path = file.webkitRelativePath ?? "";
  return folders.get(file) ?? path.slice(0, path.length - file.name.length);
}

/** Return the files of a drop, those in folders too. */
export async function dropped(transfer) {
  // entries must be taken before the first wait: the list is empty afterwards
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  return (await Promise.all(entries.map(filesIn))).flat();
}

async function filesIn(entry) {
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    folders.set(file, entry.fullPath.slice(0, -entry.name.length));
    return [file];
  }
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
 * Landmarks go with the scan that has their name, and so does what is known of a photograph. The
 * neutral is the one that is called so, and comes first.
 */
export function sorted(files, limits) {
  const own = limits.roles.flatMap(({ own_formats: formats }) => formats);
  const isScan = (file) => [...limits.raw_scan_formats, ...own].includes(suffix(file));
  const isLandmarks = (file) => limits.landmark_formats.includes(suffix(file));
  const pictures = limits.roles.find(({ role }) => role === "photo")?.formats ?? [];
  const isPicture = (file) => pictures.includes(suffix(file));
  const meshes = files.filter((file) => isScan(file) && !isLandmarks(file));
  const stems = new Set(meshes.map(stem));
  // a .csv may hold either: landmarks if a scan has its name or it says so itself
  const landmarks = files.filter(
    (file) => isLandmarks(file) && (!isScan(file) || LANDMARKS.test(stem(file)) || stems.has(stem(file))),
  );
  // pictures among scans are the scans' textures
  const areTextures = meshes.some((file) => limits.raw_scan_formats.includes(suffix(file)));
  const scans = files.filter(
    (file) => isScan(file) && !landmarks.includes(file) && !(isPicture(file) && areTextures),
  );
  const names = named(scans.map(({ name }) => name), limits.roles);
  const of = (file) => landmarks.find((other) => stem(other).replace(LANDMARKS, "") === stem(file)) ?? null;
  const found = scans.map((file, i) => ({
    file,
    ...names[i],
    landmarks: of(file),
  }));
  const taken = new Set(found.flatMap(({ file, landmarks: its }) => [file, its]));
  found.sort((a, b) => (b.role === "neutral") - (a.role === "neutral") || a.name.localeCompare(b.name));
  return { scans: found, others: files.filter((file) => !taken.has(file)) };
}

/**
 * Return name and role of scans by their files' names; a name that cannot be made of them is empty.
 *
 * `roles` are those of the service's limits: an ending that one role alone has says that one.
 * The command line has the same rule in `myoface/names.py`; both are tried on the same cases.
 */
export function named(files, roles) {
  const found = files.map((name) => ({ name: stem({ name }), role: roleOf({ name }, roles) }));
  const start = found.some(({ role }) => role === "neutral") ? lengthOfPerson(found.map(({ name }) => name)) : 0;
  return found.map(({ name, role }) => ({ name: asName(name.slice(start)), role }));
}

function roleOf(file, roles) {
  const only = roles.find(({ own_formats: formats }) => formats.includes(suffix(file)));
  if (only) return only.role;
  const words = plain(stem(file)).replace(/([a-z])([A-Z])/g, "$1 $2").toLowerCase();
  return words.split(/[^a-z]+/).some((word) => NEUTRAL.includes(word)) ? "neutral" : "expression";
}

/** Return how much of each is the person, up to a blank, `_` or `-`: nothing of a single one. */
function lengthOfPerson(stems) {
  if (stems.length < 2) return 0;
  let common = 0;
  while (common < stems[0].length && stems.every((each) => each[common] === stems[0][common])) common++;
  const length = /^.*[ _-]/s.exec(stems[0].slice(0, common))?.[0].length ?? 0;
  return stems.every((each) => /[A-Za-z]/.test(asName(each.slice(length)))) ? length : 0;
}

function asName(text) {
  if (DEVICES.test(text)) return "";
  if (LEGAL.test(text) && !text.endsWith(".")) return text;
  const whole = plain(text).replace(/[^A-Za-z0-9_.-]+/g, "_").replace(/^[^A-Za-z0-9]+|[^A-Za-z0-9]+$/g, "");
  const name = whole.slice(0, LONGEST_NAME).replace(/\.+$/, "");
  return DEVICES.test(name) ? "" : name;
}

function plain(text) {
  const letters = [...text].map((each) => LETTERS[each] ?? each).join("");
  return letters.normalize("NFKD").replace(/[\u0300-\u036f]/g, "");
}

function suffix({ name }) {
  const dot = name.lastIndexOf(".");
  return dot > 0 ? name.slice(dot).toLowerCase() : "";
}

function stem(file) {
  return file.name.slice(0, file.name.length - suffix(file).length);
}

/** Return how many vertices an OBJ or PLY has; null: it is neither, or shows none. */
export async function countVertices(file) {
  if (suffix(file) === ".ply") {
    const header = await file.slice(0, LONGEST_HEADER).text();
    return Number(/^element vertex (\d+)\s*$/m.exec(header)?.[1] ?? 0) || null;
  }
  return suffix(file) === ".obj" ? (await countInObj(file)) || null : null;
}

/** Count the lines that begin with "v ": its bytes come in parts that may end anywhere. */
async function countInObj(file) {
  let [count, before, last] = [0, NEW_LINE, 0]; // the byte before the last one, and the last one
  const reader = file.stream().getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    for (const byte of part.value) {
      if (last === V && before === NEW_LINE && (byte === BLANK || byte === TAB)) count++;
      before = last || NEW_LINE;
      last = byte;
    }
  }
  return count;
}
