// The container (docs/format.md): header, table of blocks, checks, sections. Nothing in a file is trusted, and what is
// refused is refused in the words of potr_cl/codec/container.py.

import { Decompress, decompress } from 'fzstd';

/** A file that cannot be decoded, or a wish that it cannot fulfil. */
export class PotrError extends Error {
  name = 'PotrError';
}

/** @typedef {{name: string, title: string, stored: number, raw: number, crc: number, offset: number}} Section */
/**
 * @typedef {object} Block
 * @property {number} number
 * @property {number} splats
 * @property {number} degree of the SH coefficients
 * @property {number} depth of the octree
 * @property {number[]} cube origin x, y, z and side of the octree's root
 * @property {number[]} box smallest x, y, z, largest x, y, z
 * @property {number} level of detail, 0 is the finest
 * @property {number} error
 * @property {number} quantiser
 * @property {number} coder 0: plain streams, 1: bundles
 * @property {number[]} factors scale factors of scale, rotation, opacity, DC, AC
 * @property {Section[]} sections
 * @property {number} first splat's number among those of its level
 * @property {number} offset of its first byte in the file
 * @property {number} bytes
 * @property {boolean} single whether the file has no other block
 */
/**
 * @typedef {object} Header
 * @property {Block[]} blocks
 * @property {Section[]} sections of the file's own
 * @property {number} size
 * @property {number} degree
 * @property {boolean} antialiased
 * @property {number} lowPass
 */

export const FIXED_BYTES = 32;
const MAGIC = 'POTR\r\n\x1a\n';
const MOST_SPLATS = 2 ** 22, MOST_SECTIONS = 32, MOST_LEVELS = 52, MOST_PLANES = 7, MOST_METADATA = 65536;
const LONG = 2 ** 23;
const FREE_SPLATS = 65536, MOST_A_BYTE = 8, MOST_EXPANSION = 32768, LARGEST = (2 - 2 ** -23) * 2 ** 127;

/** Sections in their order: title and streams. @type {Record<string, [string, number]>} */
export const SECTIONS = {
  OCCU: ['occupancy', 0], SEVE: ['several', 0], MULT: ['multiplicity', 0], LEAF: ['leaf level', 0], TAIL: ['tail', 0],
  STEP: ['steps', 0], OPAC: ['opacity', 1], SCAL: ['scale', 3], ROTA: ['rotation', 3], SHC0: ['sh0', 3],
  SHC1: ['sh1', 9], SHC2: ['sh2', 15], SHC3: ['sh3', 21], meta: ['metadata', 0],
};
const ORDER = Object.keys(SECTIONS).slice(0, -1);
/** @param {string} name */
const known = (name) => (Object.hasOwn(SECTIONS, name) ? SECTIONS[name] : null);

/** @param {string} message @returns {never} */
export function refuse(message) {
  throw new PotrError(message);
}

/** Sixteen tables, so that sixteen bytes are taken at a time: the k-th is of a byte that k others follow. */
const CRC = new Int32Array(16 * 256);
for (let n = 0; n < 256; n++) {
  let c = n;
  for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
  CRC[n] = c;
}
for (let n = 256; n < CRC.length; n++) CRC[n] = CRC[CRC[n - 256] & 255] ^ (CRC[n - 256] >>> 8);

/** Of four bytes that stand before so many others. @param {number} x @param {number} at @returns {number} */
const crcOf = (x, at) => CRC[at + 768 + (x & 255)] ^ CRC[at + 512 + ((x >>> 8) & 255)] ^ CRC[at + 256 + ((x >>> 16) & 255)] ^ CRC[at + (x >>> 24)];

/** @param {Uint8Array} bytes */
function crc32(bytes) {
  const words = view(bytes);
  let c = -1, i = 0;
  for (; i + 16 <= bytes.length; i += 16) {
    const word = (/** @type {number} */ k) => words.getInt32(i + 4 * k, true);
    c = crcOf(c ^ word(0), 3072) ^ crcOf(word(1), 2048) ^ crcOf(word(2), 1024) ^ crcOf(word(3), 0);
  }
  for (; i < bytes.length; i++) c = CRC[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}

/** A float as Python writes it. @param {number} x */
function float(x) {
  if (x !== x) return 'nan';
  if (!isFinite(x)) return x < 0 ? '-inf' : 'inf';
  if (Object.is(x, -0)) return '-0.0';
  const exponent = x ? +x.toExponential().split('e')[1] : 0;
  if (exponent < -4 || exponent > 15) return x.toExponential().replace(/e([+-])(\d)$/, 'e$10$2');
  return Number.isInteger(x) ? BigInt(x) + '.0' : '' + x;
}

/** @param {number} number @param {number} bytes @param {boolean} trust */
function checkClaim(number, bytes, trust, what = 'splats') {
  if (!trust && number > FREE_SPLATS + MOST_A_BYTE * bytes)
    refuse(`${number} ${what} in ${bytes} bytes are more than a real scene packs into them, and could fill the memory: ` +
      'if you know where the file comes from, read it with --trust (in Python: trust=True)');
}

/** @param {number} blocks @param {number} splats @param {string} what */
function checkNumber(blocks, splats, what) {
  if (blocks > 16 + Math.floor(splats / 16384)) refuse(`${blocks} blocks are too many for ${what}`);
}

/** @param {Uint8Array} bytes */
export const view = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);

/**
 * The header's size, by a file's first bytes; refuses what is no .potr file.
 * @param {Uint8Array} start @param {number} fileBytes
 */
export function headerBytes(start, fileBytes) {
  if (!fileBytes) refuse('the file is empty');
  const magic = String.fromCharCode(...start.subarray(0, 8));
  if (magic !== MAGIC) {
    if (magic.startsWith('POTR')) refuse('the file was changed in transfer (line ends were converted): copy it again as binary');
    refuse("not a .potr file (its first bytes are not 'POTR'); scenes of other formats are read by convert");
  }
  if (start.length < FIXED_BYTES) refuse(`truncated: ${fileBytes} bytes do not even hold the header`);
  const version = view(start).getUint16(8, true);
  if (version !== 1) refuse(`format version ${version}, this potr_cl reads version 1: update potr_cl`);
  return view(start).getUint32(12, true);
}

/** The size that the whole file must have. @param {Uint8Array} start */
export const saidBytes = (start) => view(start).getBigUint64(16, true);

/**
 * Parses and verifies header and table.
 * @param {Uint8Array} data all of the header at least
 * @param {number} fileBytes
 * @param {boolean} trust
 * @returns {Header}
 */
export function readHeader(data, fileBytes, trust) {
  const size = headerBytes(data.subarray(0, FIXED_BYTES), fileBytes);
  const at = view(data);
  if (data.length < size) refuse(`truncated: the header has ${size} bytes, the file ${fileBytes}`);
  if (size < FIXED_BYTES + 4 || crc32(data.subarray(0, size - 4)) !== at.getUint32(size - 4, true))
    refuse('the header is damaged (its checksum does not match): get the file again');
  const said = saidBytes(data);
  if (said !== BigInt(fileBytes))
    refuse(`${fileBytes < said ? 'truncated' : 'followed by something else'}: the file has ${fileBytes} bytes, its header says ${said}`);
  const flags = data[10], degree = data[11], count = at.getUint32(24, true), quantiser = data[28], own = data[29];
  if (![0, 1, 3].includes(flags) || quantiser > 1 || at.getUint16(30, true))
    refuse(`a file with flags ${flags} and quantiser ${quantiser} is unknown: update potr_cl`);
  if (degree > 3 || count < 1 || own > MOST_SECTIONS) refuse(`invalid header: ${count} blocks, SH degree ${degree}`);
  if (!trust) checkNumber(count, FREE_SPLATS + MOST_A_BYTE * fileBytes, `a file of ${fileBytes} bytes`);

  let read = FIXED_BYTES, offset = size;
  const end = size - 4;
  /** @param {number} bytes */
  const next = (bytes) => {
    if (read + bytes > end) refuse('the header is damaged (its table is longer than it says): get the file again');
    read += bytes;
    return read - bytes;
  };
  /** @param {number} number @param {string[]} known_ @param {string} where */
  const sections = (number, known_, where) => {
    /** @type {Section[]} */
    const found = [], start = offset;
    let place = 0;
    for (let k = 0; k < number; k++) {
      const from = next(16), name = String.fromCharCode(...data.subarray(from, from + 4));
      if (!/^[A-Za-z][A-Za-z0-9]{3}$/.test(name)) refuse(`${where} has a section with an invalid name: get the file again`);
      const title = known(name)?.[0] ?? name, what = `section '${title}'`;
      const [stored, raw, crc] = [4, 8, 12].map((k) => at.getUint32(from + k, true));
      const rank = known_.indexOf(name);
      if (rank >= 0) {
        if (rank < place) refuse(`${what} stands twice, or not in its place`);
        place = rank + 1;
      } else if (name < 'a') refuse(`${where} needs a section '${name}' that this potr_cl does not know: update it`);
      if (stored > fileBytes - offset) refuse(`${what} reaches beyond the end of the file`);
      if (raw > stored * MOST_EXPANSION) refuse(`${what} claims a size of ${raw}, more than its ${stored} stored bytes can hold`);
      found.push({ name, title, stored, raw, crc, offset: offset - start });
      offset += stored;
    }
    return found;
  };

  const files = sections(own, ['meta'], 'the file');
  if (files.some((section) => section.name === 'meta' && section.raw > MOST_METADATA))
    refuse(`section 'metadata' is longer than ${MOST_METADATA} bytes`);
  /** @type {Block[]} */
  const blocks = [];
  const order = ORDER.filter((name) => !name.startsWith('SHC') || +name[3] <= degree);
  for (let number = 0; number < count; number++) {
    const what = `block ${number}`, from = next(76), before = blocks[number - 1];
    const [level, coder, depth, some] = data.subarray(from, from + 4), splats = at.getUint32(from + 4, true);
    /** @param {number} begin @param {number} n */
    const reals = (begin, n) => Array.from({ length: n }, (_, k) => at.getFloat32(from + begin + 4 * k, true));
    const box = reals(8, 6), origin = reals(32, 3), error = reals(44, 1)[0], side = at.getFloat64(from + 48, true), factors = reals(56, 5);
    if (coder > 1 || (coder && !quantiser)) refuse(`${what} is of coder ${coder}, which is unknown: update potr_cl`);
    if (splats < 1 || splats > MOST_SPLATS || depth > MOST_LEVELS || some > MOST_SECTIONS)
      refuse(`${what} is invalid: ${splats} splats, octree of ${depth} levels, ${some} sections`);
    if (!box.every(isFinite) || [0, 1, 2].some((k) => box[k] > box[k + 3])) refuse(`${what} is invalid: its box is [${box.map(float).join(', ')}]`);
    if (!origin.every(isFinite) || !(side >= 0 && side <= 2 * LARGEST)) refuse(`${what} is invalid: its root cube is not finite`);
    if (!factors.every((x) => x >= Math.fround(1e-3) && x <= 1e9)) refuse(`${what} is invalid: a scale factor outside 0.001 to 1e9`);
    if (!(error >= 0 && error < Infinity) || (before && (before.level < level || before.level > level + 1)))
      refuse(`${what} is invalid: level ${level}, error ${float(error)}`);
    const start = offset, own = sections(some, order, what);
    /** @type {Block} */
    const block = {
      number, splats, degree, depth, cube: [...origin, side], box, level, error, quantiser, coder, factors, sections: own,
      first: before?.level === level ? before.first + before.splats : 0, offset: start, bytes: offset - start, single: count === 1,
    };
    checkClaim(splats, block.bytes, trust);
    checkSizes(block, what);
    const cells = find(block, 'OCCU');
    if (cells) checkClaim(cells.raw, block.bytes, trust, 'octree cells');
    blocks.push(block);
  }
  if (blocks[count - 1].level || read !== end || offset !== fileBytes)
    refuse('the sections do not fill the file, or the table its place, or the finest level is not there');
  const splats = blocks.reduce((sum, block) => sum + block.splats, 0);
  checkNumber(count, splats, `${splats} splats`);
  checkClaim(splats, fileBytes, trust);
  return { blocks, sections: files, size, degree, antialiased: flags > 0, lowPass: flags === 3 ? 0.1 : 0.3 };
}

/** @param {Block} block @param {string} name */
export const find = (block, name) => block.sections.find((section) => section.name === name);

/** The bytes of a block up to the coefficients of a degree. @param {Block} block @param {number} degree */
export const bytesTo = (block, degree) =>
  Math.min(block.bytes, ...block.sections.filter((s) => s.name.startsWith('SHC') && known(s.name) && +s.name[3] > degree).map((s) => s.offset));

/** @param {Block} block @param {string} what */
function checkSizes(block, what) {
  const { splats, depth } = block;
  /** @type {Record<string, number>} */
  const most = {
    OCCU: splats * depth, SEVE: Math.floor((splats + (find(block, 'OCCU')?.raw ?? 0) + 7) / 8), MULT: 4 * (splats >> 1),
    LEAF: splats, TAIL: 3 * depth * ((splats + 7) >> 3), STEP: block.quantiser ? 50 + splats : 0,
  };
  for (const section of block.sections) {
    const streams = known(section.name)?.[1];
    if (streams === undefined) continue;
    const asIs = streams > 0 && block.coder === 1;
    if (section.raw > (asIs ? section.stored : most[section.name] ?? streams * (1 + MOST_PLANES * splats)))
      refuse(`${what}: section '${section.title}' holds ${section.raw} bytes, more than ${splats} splats in an octree of ${depth} levels can need`);
    if (asIs && section.raw !== section.stored) refuse(`${what}: section '${section.title}' is of bundles, and not stored as it is`);
  }
  if (!find(block, 'OPAC')) refuse(`${what}: there is no opacity section`);
}

/** A section's bytes as they are stored. @param {Uint8Array} data of the block @param {Section} section */
export function storedBytes(data, section) {
  const stored = data.subarray(section.offset, section.offset + section.stored);
  if (stored.length !== section.stored || crc32(stored) !== section.crc)
    refuse(`section '${section.title}' is damaged (its checksum does not match): get the file again`);
  return stored;
}

/** A section's content. @param {Uint8Array} data of the block @param {Section} section */
export function readSection(data, section) {
  const stored = storedBytes(data, section);
  if (section.stored === section.raw) return stored;
  const size = frameSize(stored);
  if (size !== section.raw) refuse(`section '${section.title}' decompresses to another size than the header says`);
  return inflated(stored, size, section.title);
}

/** Where a Zstandard frame's first block begins, and the size that it names; −1 if it names none, or is none. @param {Uint8Array} d */
function frame(d) {
  const single = (d[4] >> 5) & 1, kind = d[4] >> 6, bytes = kind ? 1 << kind : single, begin = 6 - single + [0, 1, 2, 4][d[4] & 3] + bytes;
  if (d.length < begin || view(d).getUint32(0, true) !== 0xfd2fb528 || !bytes) return [0, -1];
  let size = kind === 1 ? 256 : 0;
  for (let k = 0; k < bytes; k++) size += d[begin - bytes + k] * 256 ** k;
  return [begin, size];
}

/** The size that a Zstandard frame names; −1 if it names none, or is none. @param {Uint8Array} d */
export const frameSize = (d) => frame(d)[1];

/**
 * The content of one Zstandard frame that names its size. fzstd trusts more than is wise: so the frame's blocks are
 * counted here, and what they unpack to. Where content is long it does not tell how much that was, and takes ages where it
 * does: what is missing there is 0.
 * @param {Uint8Array} d @param {number} size @param {string} what
 */
export function inflated(d, size, what) {
  /** @param {unknown} how @returns {never} */
  const bad = (how) => refuse(`section '${what}' does not decompress: ${how}`);
  let at = frame(d)[0];
  if (d[4] & 3) bad('it needs a dictionary');
  for (let last = 0; !last; ) {
    last = d[at] & 1;
    const type = (d[at] >> 1) & 3;
    at += 3 + (type === 1 ? 1 : (d[at] >> 3) | (d[at + 1] << 5) | (d[at + 2] << 13));
    if (!(at <= d.length)) bad('unexpected EOF');
  }
  if (at + (d[4] & 4) !== d.length) bad('the frame does not fill it');
  const out = new Uint8Array(size);
  let written = 0;
  try {
    if (size > LONG) {
      decompress(d, out);
      return out;
    }
    const stream = new Decompress((some) => {
      if (written + some.length <= size) out.set(some, written);
      written += some.length;
    });
    stream.push(d, true);
  } catch (error) {
    bad(/** @type {Error} */ (error).message);
  }
  return written === size ? out : bad('its content is of another size');
}

/** A file's metadata; strict where JSON.parse is lenient. @param {Uint8Array} raw @returns {Record<string, unknown>} */
export function parseMetadata(raw) {
  try {
    const text = new TextDecoder('utf-8', { fatal: true, ignoreBOM: true }).decode(raw) || '{}', facts = JSON.parse(text);
    // Half of a surrogate pair stands in no UTF-8, but as \ud800 in a string.
    /** @param {unknown} x @returns {boolean} */
    const sound = (x) =>
      typeof x === 'string' ? !/\p{Surrogate}/u.test(x) : !x || typeof x !== 'object' || Object.entries(x).every(([key, value]) => sound(key) && sound(value));
    const numbers = text.replace(/"(?:[^"\\]|\\.)*"/g, '""').match(/-?\d[\d.eE+-]*/g) ?? [];
    const finite = numbers.every((n) => (/[.eE]/.test(n) ? isFinite(+n) : n.length <= 20 && BigInt.asIntN(64, BigInt(n)) === BigInt(n) && BigInt(n) !== -(2n ** 63n)));
    if (facts && typeof facts === 'object' && !Array.isArray(facts) && finite && sound(facts)) return facts;
  } catch {}
  return refuse("section 'metadata' is not a JSON object");
}
