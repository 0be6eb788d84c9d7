// Pack an OBJ or PLY with its MTL files and images, as an upload is one file.
// The same files give the same bytes, here and by the client (myoface/client/scan_packing.py).

const DIRECTORY = 0x02014b50;
const END = 0x06054b50;
const MEMBER = 0x04034b50;
const VERSION = 20;
const UTF8 = 0x0800; // names are in it
const DATE = 0x0021; // 1 January 1980
const MADE_BY = 0x0314; // Unix
const MODE = 0x01800000; // its owner's to read and write
const MOST_MTL = 1 << 24;
const MOST_HEADER = 1 << 16; // of a PLY
const PIECE = 1 << 22;

const LIBRARY = /^mtllib[ \t]+(.+?)[ \t\r]*$/gm;
const IMAGE = /^[ \t]*map_Kd[ \t]+(.+?)[ \t\r]*$/gim;
const UDIM = /<UDIM>/gi; // in an image's name: the number of a tile
const TILE = /1\d{3}/g;
const COMMENT = /^comment[ \t]+TextureFile[ \t]+(.+?)[ \t\r]*$/gm;

/** Return the MTL files and images that an OBJ or PLY names among the `files` of its folder. */
export async function imagesOf(scan, files) {
  if (/\.ply$/i.test(scan.name)) return named(await lines(scan, MOST_HEADER, COMMENT), files);
  if (!/\.obj$/i.test(scan.name)) return [];
  // in the first lines, where every scanner writes it
  const libraries = named(await lines(scan, PIECE, LIBRARY), files);
  const images = [];
  for (const library of libraries) images.push(...named(await lines(library, MOST_MTL, IMAGE), files));
  return [...new Set([...libraries, ...images])].filter((file) => file !== scan);
}

/** Return what stands behind a keyword, in the first bytes of a file. */
async function lines(file, most, keyword) {
  const text = await file.slice(0, most).text();
  return [...text.matchAll(keyword)].map(([, line]) => line);
}

/** Return the files whose names lines end with: names may have blanks, options come before them. */
function named(lines, files) {
  const isNamed = (line, name) => line === name || line.endsWith(` ${name}`) || line.endsWith(`./${name}`);
  return lines.flatMap((line) => tiled(line, files)).flatMap((line) => {
    const found = files.filter(({ name }) => isNamed(line, name));
    return found.sort((a, b) => b.name.length - a.name.length).slice(0, 1);
  });
}

/** Return a line, one with `<UDIM>` once for each tile that may be among the `files`. */
function tiled(line, files) {
  if (line.search(UDIM) < 0) return [line];
  const numbers = new Set(files.flatMap(({ name }) => name.match(TILE) ?? []));
  return [...numbers].sort().map((number) => line.replace(UDIM, number));
}

/** Return a scan and its images as a ZIP, or a scan without any as it is. */
export async function packed(scan, images) {
  if (!images.length) return scan;
  const files = [scan, ...images].sort((a, b) => (a.name < b.name ? -1 : 1));
  const parts = [];
  const directory = [];
  let place = 0;
  for (const file of files) {
    const title = new TextEncoder().encode(file.name);
    const fields = [await checksum(file), file.size, file.size];
    const header = [[MEMBER, 4], [VERSION, 2], ...about(title, fields)];
    const head = bytesOf(header, title);
    parts.push(head, file);
    const more = [[0, 2], [0, 2], [0, 2], [MODE, 4], [place, 4]];
    directory.push(bytesOf([[DIRECTORY, 4], [MADE_BY, 2], [VERSION, 2], ...about(title, fields), ...more], title));
    place += head.length + file.size;
  }
  const size = directory.reduce((sum, { length }) => sum + length, 0);
  const count = files.length;
  const end = [[END, 4], [0, 2], [0, 2], [count, 2], [count, 2], [size, 4], [place, 4], [0, 2]];
  const { name, lastModified } = scan;
  const whole = [...parts, ...directory, bytesOf(end)];
  return new File(whole, name.replace(/(obj|ply)$/i, "zip"), { type: "application/zip", lastModified });
}

/** Return what a member's header and its entry in the directory have in common. */
function about(title, [crc, stored, size]) {
  const flags = title.every((byte) => byte < 128) ? 0 : UTF8;
  return [[flags, 2], [0, 2], [0, 2], [DATE, 2], [crc, 4], [stored, 4], [size, 4], [title.length, 2], [0, 2]];
}

/** Return numbers as little-endian bytes of the widths beside them, and bytes after them. */
function bytesOf(fields, after = new Uint8Array()) {
  const length = fields.reduce((sum, [, width]) => sum + width, 0);
  const view = new DataView(new ArrayBuffer(length));
  let at = 0;
  for (const [value, width] of fields) {
    if (width === 4) view.setUint32(at, value, true);
    else view.setUint16(at, value, true);
    at += width;
  }
  const bytes = new Uint8Array(length + after.length);
  bytes.set(new Uint8Array(view.buffer));
  bytes.set(after, length);
  return bytes;
}

const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let rest = byte;
  for (let bit = 0; bit < 8; bit++) rest = rest & 1 ? 0xedb88320 ^ (rest >>> 1) : rest >>> 1;
  return rest;
});

/** Return the CRC-32 of a file. */
async function checksum(file) {
  let crc = 0xffffffff;
  for (let start = 0; start < file.size; start += PIECE) {
    const piece = new Uint8Array(await file.slice(start, start + PIECE).arrayBuffer());
    for (const byte of piece) crc = TABLE[(crc ^ byte) & 255] ^ (crc >>> 8);
  }
  return (crc ^ 0xffffffff) >>> 0;
}
