// What sections of bundles say of their streams (docs/format.md, "Description", "Contexts").

import { frameSize, inflated, refuse, view } from './container.js';

/**
 * @typedef {object} Stream
 * @property {number} terms of its contexts
 * @property {number} biases
 * @property {Int16Array} sizes of its tokens
 */
/**
 * @typedef {object} Model
 * @property {Stream} stream
 * @property {Int32Array} numbers weights of terms, of recent sizes, constant, biases
 * @property {Uint8Array} classes context of each expected size
 * @property {Uint16Array} frequencies (contexts, alphabet)
 * @property {number} contexts
 * @property {number} alphabet
 */

const DIRECT = 128, ALPHABET = 252, MOST_CONTEXTS = 32, KNOWN_TOKENS = 216, KNOWN_RECENT = 28;

/** The least of the integers that a token stands for. @param {number} token */
const floorOf = (token) => (token < DIRECT ? token : (4 + (token % 4)) * 2 ** (5 + ((token - DIRECT) >> 2)));
/** The largest of them. @param {number} token */
export const largestOf = (token) => (token < DIRECT ? token : (5 + (token % 4)) * 2 ** (5 + ((token - DIRECT) >> 2)) - 1);

/** Sizes of tokens by what they stand for. @param {(u: number) => number} magnitude */
const sizes = (magnitude) => Int16Array.from({ length: ALPHABET }, (_, k) => Math.floor(16 * Math.log2(1 + magnitude(floorOf(k))) + 0.5));
const UNSIGNED = sizes((u) => u), SIGNED = sizes((u) => Math.floor((u + 1) / 2)), NOT_0 = sizes((u) => Math.floor((u + 2) / 2));
const PATTERNS = Int16Array.from({ length: 8 }, (_, k) => (k > 1 ? 128 : 0));
/** @param {number} mask @returns {number} */
const bits = (mask) => mask && (mask & 1) + bits(mask >> 1);

/** The streams of a section. @param {string} name @returns {Stream[]} */
export function streamsOf(name) {
  /** @param {number} terms @param {Int16Array} sizes */
  const stream = (terms, sizes, biases = 0) => ({ terms, sizes, biases });
  if (name === 'OPAC') return [stream(0, UNSIGNED)];
  if (name === 'SCAL') return [0, 1, 2].map((a) => stream(a, UNSIGNED));
  if (name === 'ROTA') return [6, 7, 8].map((a) => stream(a, SIGNED));
  if (name === 'SHC0') return [5, 6, 7].map((a) => stream(a, SIGNED));
  const width = 2 * +name[3] + 1, masks = Int16Array.from({ length: 1 << width }, (_, mask) => 32 * bits(mask));
  return [stream(11, masks), stream(5, PATTERNS, width), ...[6, 7, 8].map((a) => stream(a, NOT_0, width))];
}

/** The model of so many tokens that decoders know. @param {number} alphabet */
function knownModel(alphabet) {
  const frequencies = new Uint16Array(MOST_CONTEXTS * alphabet), rest = BigInt(4096 - alphabet);
  for (let k = 0; k < MOST_CONTEXTS; k++) {
    const c = ((k % 2 ? 5793 : 4096) * 2 ** (k >> 1)) / 64 | 0, square = BigInt(c) ** 2n;
    const below = (/** @type {number} */ token) => {
      const r = BigInt(c + 16 * Math.min(floorOf(token), 2 ** 20)) ** 2n;
      return Number((rest * (r - square)) / r) + token;
    };
    for (let a = 0, from = below(0); a < alphabet; a++) {
      const to = a + 1 < alphabet ? below(a + 1) : 4096;
      frequencies[k * alphabet + a] = to - from;
      from = to;
    }
  }
  return { classes: Uint8Array.from({ length: 256 }, (_, size) => size >> 3), frequencies, contexts: MOST_CONTEXTS, alphabet };
}

/**
 * The models of a section's streams.
 * @param {Uint8Array} stored description
 * @param {string} name of the section
 * @param {string} what it is called
 * @returns {Model[]}
 */
export function readDescription(stored, name, what) {
  const streams = streamsOf(name);
  /** @param {Stream} stream */
  const weights = (stream) => stream.terms + 2 + stream.biases;
  if (!stored.length)
    return streams.map((stream) => {
      const numbers = new Int32Array(weights(stream));
      numbers[stream.terms] = KNOWN_RECENT;
      return { stream, numbers, ...knownModel(Math.min(stream.sizes.length, KNOWN_TOKENS)) };
    });
  const all = streams.reduce((sum, stream) => sum + weights(stream), 0);
  const most = streams.reduce((sum, { sizes }) => sum + 2 + MOST_CONTEXTS - 1 + 2 * MOST_CONTEXTS * sizes.length, 2 * all);
  const size = frameSize(stored);
  if (size < 0 || size > most) refuse(`section '${what}' describes its contexts at an impossible length`);
  const raw = inflated(stored, size, what), impossible = () => refuse(`section '${what}' describes impossible contexts`);
  if (raw.length < 2 * all) impossible();
  let at = 0, read = 2 * all;
  const models = streams.map((stream) => {
    const numbers = Int32Array.from({ length: weights(stream) }, () => view(raw).getInt16((at += 2) - 2, true));
    if (raw.length < read + 2) impossible();
    const contexts = raw[read++], alphabet = raw[read++], cells = contexts * alphabet;
    if (contexts < 1 || contexts > MOST_CONTEXTS || alphabet < 1 || alphabet > stream.sizes.length || raw.length < read + contexts - 1 + 2 * cells)
      impossible();
    const ends = [...raw.subarray(read, (read += contexts - 1)), 256], classes = new Uint8Array(256);
    ends.forEach((end, k) => {
      const begin = k ? ends[k - 1] : 0;
      if (end <= begin) impossible();
      classes.fill(k, begin, end);
    });
    const frequencies = new Uint16Array(cells);
    for (let k = 0; k < contexts; k++) {
      let sum = 0;
      for (let a = 0; a < alphabet; a++)
        sum += frequencies[k * alphabet + a] = raw[read + a * contexts + k] | (raw[read + cells + a * contexts + k] << 8);
      if (sum !== 4096) impossible();
    }
    read += 2 * cells;
    return { stream, numbers, classes, frequencies, contexts, alphabet };
  });
  if (read !== raw.length) impossible();
  return models;
}
