// A block's splats (docs/format.md, "Positions", "Plain streams", "Bundles"): what stands around the C, in WebAssembly.

import { PotrError, SECTIONS, find, readSection, refuse, storedBytes, view } from './container.js';
import { largestOf, readDescription } from './streams.js';

/** @typedef {import('./container.js').Block} Block */
/** @typedef {import('./engine.js').Exports} Exports of WebAssembly */
/**
 * Arrays of n splats, float32.
 * @typedef {object} Values
 * @property {Float32Array} scales (n, 3) natural logarithms of standard deviations
 * @property {Float32Array} rotations (n, 4) w, x, y, z
 * @property {Float32Array} opacities (n) logits
 * @property {Float32Array} sh (n, M, 3) SH coefficients
 */

export const BUNDLE = 8192;
/** Sections of bundles in the order of decoding, and where the streams of each begin. */
const CHAIN = ['OPAC', 'SCAL', 'SHC0', 'SHC1', 'SHC2', 'SHC3', 'ROTA'];
const STREAMS = [0, 1, 4, 7, 12, 17, 22];
const LOWEST = 65536, LARGEST = 2 ** 29, DEEPEST_NARROW = 32, LENGTHS = 53;

/** @param {number} splats */
const bundlesOf = (splats) => Math.ceil(splats / BUNDLE);

/** A section of bundles, taken apart. @param {Uint8Array} stored @param {string} name @param {string} what @param {number} splats */
function sectionOf(stored, name, what, splats) {
  const bundles = bundlesOf(splats), begins = name === 'OPAC' || name === 'ROTA';
  const lanes = begins ? 32 * Math.floor(splats / BUNDLE) + Math.ceil((splats % BUNDLE) / 256) : 0;
  const damaged = (/** @type {string} */ how) => refuse(`section '${what}' ${how}`);
  if (stored.length < 4) damaged('ends too early');
  const at = 4 + view(stored).getUint32(0, true), words = at + 4 * (lanes + bundles);
  if (words > stored.length) damaged('ends too early');
  const models = readDescription(stored.subarray(4, at), name, what), numbers = view(stored);
  for (let k = 0; k < lanes; k++) if (numbers.getUint32(at + 4 * k, true) < LOWEST) damaged('holds an impossible state');
  let sum = 0;
  for (let k = 0; k < bundles; k++) sum += numbers.getUint32(words - 4 * (bundles - k), true);
  if (stored.length - words !== 2 * sum) damaged('does not hold the words that its bundles ask for');
  const counts = words - 4 * bundles;
  return { name, models, states: stored.subarray(at, counts), counts: stored.subarray(counts, words), words: stored.subarray(words) };
}

/** Decodes a block, and then another. */
export class Decoder {
  /** @param {import('./engine.js').Engine} engine */
  constructor(engine) {
    this.engine = engine;
    this.id = -1;
    /** @type {Exports} */
    this.c = {};
    /** Where memory is free. */
    this.top = 0;
  }

  /**
   * Opens a block, unless it is the one that was opened last.
   * @param {number} id of it
   * @param {Block} block
   * @param {Uint8Array} data its bytes, up to the degree
   * @param {number} degree of the SH coefficients that are wanted
   */
  async open(id, block, data, degree) {
    if (this.id === id) return;
    this.id = -1;
    this.block = block;
    this.data = data;
    this.count = (degree + 1) ** 2;
    await this.telling(() => (block.coder ? this.openBundles(degree) : this.openPlain(degree)));
    this.id = id;
  }

  /** Says of which block an error is. @template T @param {() => T | Promise<T>} work @returns {Promise<T>} */
  async telling(work) {
    try {
      return await work();
    } catch (error) {
      const block = /** @type {Block} */ (this.block);
      if (error instanceof PotrError && !block.single) throw new PotrError(`block ${block.number}: ${error.message}`);
      throw error;
    }
  }

  // ---------------------------------------------------------------------------------------------------- memory

  /** Some bytes of WebAssembly's memory, for the block. @param {number} bytes */
  reserve(bytes) {
    const at = this.top, memory = this.c.memory;
    this.top = Math.ceil((at + bytes + 16) / 16) * 16; // C may read a few bytes too many
    if (this.top > memory.buffer.byteLength) {
      try {
        memory.grow(Math.ceil((this.top - memory.buffer.byteLength) / 65536));
      } catch {
        refuse(`the scene needs more memory than there is`);
      }
    }
    return at;
  }

  /** @param {ArrayBufferView} array */
  put(array) {
    const at = this.reserve(array.byteLength);
    new Uint8Array(this.c.memory.buffer).set(new Uint8Array(array.buffer, array.byteOffset, array.byteLength), at);
    return at;
  }

  /** @param {boolean} general */
  async begin(general) {
    this.c = await this.engine.load(general);
    this.top = this.c.__heap_base.value;
    const { splats, quantiser, factors } = /** @type {Block} */ (this.block);
    this.c.potr_begin(splats, quantiser, this.count, ...factors);
  }

  /** @param {string} name */
  content(name) {
    const section = find(/** @type {Block} */ (this.block), name);
    return section ? readSection(/** @type {Uint8Array} */ (this.data), section) : new Uint8Array(0);
  }

  /** @param {Uint8Array | null} raw */
  setSteps(raw) {
    if (raw && this.c.potr_steps(this.put(raw), raw.length)) refuse("section 'steps' describes impossible steps");
  }

  get steps() {
    return find(/** @type {Block} */ (this.block), 'STEP') ? this.content('STEP') : null;
  }

  // ---------------------------------------------------------------------------------------------------- splats

  /** @param {number} degree */
  async openBundles(degree) {
    const block = /** @type {Block} */ (this.block), data = /** @type {Uint8Array} */ (this.data);
    // To the end of the chain where all is asked for: so its end is checked.
    this.sections = degree === block.degree ? 6 : 3 + degree;
    const found = [...CHAIN.slice(0, this.sections), 'ROTA'].flatMap((name) => {
      const section = find(block, name);
      return section ? [sectionOf(storedBytes(data, section), name, section.title, block.splats)] : [];
    });
    const steps = this.steps;
    await this.begin(found.some(({ models }) => models.some(({ alphabet }) => largestOf(alphabet - 1) >= LARGEST)));
    this.setSteps(steps);
    for (const { name, models, states, counts, words } of found) {
      const number = CHAIN.indexOf(name);
      models.forEach(({ stream, numbers, classes, frequencies, contexts, alphabet }, k) => {
        const pointers = [classes, frequencies].map((array) => this.put(array));
        this.c.potr_stream(
          STREAMS[number] + k, this.put(numbers), stream.terms, stream.biases, pointers[0], pointers[1], contexts, alphabet,
          this.put(stream.sizes), this.reserve(4096 * contexts + 3), this.reserve(1024 * contexts));
      });
      const bundles = counts.length / 4;
      this.c.potr_section(number, this.put(words), this.put(counts), bundles, this.reserve(8 * bundles + 8), this.put(states));
    }
  }

  /** @param {number} degree */
  async openPlain(degree) {
    const { splats } = /** @type {Block} */ (this.block);
    const steps = this.steps;
    await this.begin(true);
    this.setSteps(steps);
    let stream = 0;
    for (const name of ['OPAC', 'SCAL', 'ROTA', ...CHAIN.slice(2, 3 + degree)]) {
      const section = find(/** @type {Block} */ (this.block), name), number = SECTIONS[name][1];
      const raw = this.content(name), widths = raw.subarray(0, number), sum = widths.reduce((a, b) => a + b, 0);
      if (section && (widths.length < number || Math.max(...widths) > 7 || raw.length !== number + splats * sum))
        refuse(`section '${section.title}' does not hold an integer of each splat`);
      let at = section ? this.put(raw) + number : 0;
      for (let k = 0; k < number; k++, stream++) {
        this.c.potr_plain_stream(stream, at, widths[k] ?? 0);
        at += splats * (widths[k] ?? 0);
      }
    }
  }

  /**
   * Values of some bundles' splats; of the plain coder, bundles must follow each other from the first on.
   * @param {number} from @param {number} to bundles
   * @param {Values} into arrays
   * @param {number} at the number of the first of these splats in the arrays
   */
  values(from, to, into, at) {
    return this.telling(() => {
      const { splats, coder } = /** @type {Block} */ (this.block), width = 3 * (this.count ?? 0);
      for (let bundle = from; bundle < to; bundle++) {
        if (coder) {
          const said = this.c.potr_bundle(bundle, this.sections);
          if (said) {
            const title = find(/** @type {Block} */ (this.block), CHAIN[said >> 8])?.title ?? '';
            refuse(`section '${title}' ${(said & 255) === 1 ? 'ends too early' : 'does not end where its last token does'}`);
          }
        } else this.c.potr_plain_bundle(bundle);
        const n = Math.min(splats - bundle * BUNDLE, BUNDLE);
        /** @param {number} which @param {Float32Array} array @param {number} each */
        const copy = (which, array, each) => array.set(new Float32Array(this.c.memory.buffer, this.c.potr_out(which), n * each), at * each);
        copy(0, into.scales, 3);
        copy(1, into.rotations, 4);
        copy(2, into.opacities, 1);
        copy(3, into.sh, width);
        at += n;
      }
    });
  }

  // ---------------------------------------------------------------------------------------------------- positions

  /** Centres, (n, 3), world units: in WebAssembly's memory, until it is used again. @returns {Promise<Float32Array>} */
  positions() {
    return this.telling(() => {
      const kept = this.top;
      try {
        return this.findCentres();
      } finally {
        this.top = kept;
      }
    });
  }

  findCentres() {
    const { splats, depth, cube, box } = /** @type {Block} */ (this.block), c = this.c;
    const multiplicity = this.content('MULT');
    if (multiplicity.length % 4) refuse("section 'multiplicity' does not hold whole integers");
    const [occupancy, several, leafLevels, tails] = ['OCCU', 'SEVE', 'LEAF', 'TAIL'].map((name) => this.content(name));
    const crowd = multiplicity.length / 4, numbers = view(multiplicity);
    const streams = [this.put(occupancy), occupancy.length, this.put(several)];
    const leaves = c.potr_tree(...streams, several.length, depth, occupancy.length || crowd ? 1 : 0);
    if (!leaves) refuse("positions: the octree's nodes do not add up");
    const [singles, crowded] = new Float64Array(c.memory.buffer, leaves, 2);
    let total = singles, few = false;
    const counts = new BigUint64Array(crowd);
    for (let k = 0; k < crowd; k++) {
      const count = numbers.getUint32(4 * k, true);
      counts[k] = BigInt(count);
      total += Math.min(count, splats + 1);
      few ||= count < 2;
    }
    if (crowd !== crowded || leafLevels.length !== singles) refuse("positions: the octree's leaves do not match its multiplicities and tails");
    if (total !== splats || few) refuse(`positions: the octree holds ${total} splats, the header says ${splats}`);
    let deepest = 0;
    for (const level of leafLevels) if (level > deepest) deepest = level;
    if (deepest > depth) refuse(`positions: a leaf lies below the octree's deepest level ${depth}`);
    const multiplicities = this.put(counts), means = this.reserve(12 * splats), tail = this.put(tails);
    const lengths = c.potr_leaves(
      ...streams, depth, this.put(leafLevels), multiplicities, splats, means,
      depth > DEEPEST_NARROW ? this.reserve(24 * splats) : 0, this.reserve(2 * splats));
    let reach = 0, expected = 0;
    new BigUint64Array(c.memory.buffer, lengths, LENGTHS).slice(1).reverse().forEach((number) => {
      reach += Number(number);
      expected += 3 * Math.ceil(reach / 8);
    });
    if (expected !== tails.length) refuse(`positions: ${tails.length} bytes of tails where their lengths ask for ${expected}`);
    if (c.potr_padding(tail)) refuse("positions: a tail's padding is not zero");
    const wrong = c.potr_centres(multiplicities, tail, this.put(Float64Array.from(cube)), depth, this.put(Float32Array.from(box)), splats);
    if (wrong === 1) refuse('positions: a centre is beyond what single precision can hold');
    if (wrong) refuse("centres lie outside of the block's box: get the file again");
    return new Float32Array(c.memory.buffer, means, 3 * splats);
  }
}
