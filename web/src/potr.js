// Decodes .potr files: see README.md.

import { BUNDLE, Decoder } from './block.js';
import { PotrError, bytesTo, parseMetadata, readSection, refuse } from './container.js';
import { Engine } from './engine.js';
import { open } from './source.js';
import { NAME, serve } from './worker.js';

export { PotrError };

// This module is that of its workers, too.
if (typeof WorkerGlobalScope === 'function' && /** @type {any} */ (globalThis).name === NAME) serve();

/**
 * A scene, or some splats of it. Arrays hold float32 numbers, splat by splat.
 * @typedef {object} Splats
 * @property {number} count
 * @property {number} degree of the SH coefficients, 0 to 3
 * @property {Float32Array} positions (count, 3) x, y, z
 * @property {Float32Array} scales (count, 3) natural logarithms of standard deviations
 * @property {Float32Array} rotations (count, 4) w, x, y, z of unit quaternions
 * @property {Float32Array} opacities (count) logits
 * @property {Float32Array} sh (count, (degree + 1)², 3) R, G, B of each coefficient
 * @property {boolean} antialiased whether it is to be rendered as Mip-Splatting's scenes are
 * @property {number} lowPass what is added to covariances on screen, square pixels: 0.3 or 0.1
 */
/** @typedef {Splats & {metadata: Record<string, unknown>}} Scene */
/**
 * A block's splats: the arrays are parts of the scene's.
 * @typedef {Splats & {block: number, first: number}} Part first: the number of its first splat in the scene
 */
/**
 * @typedef {object} Options
 * @property {(part: Part) => void} [onBlock] called with each block, as soon as it is decoded
 * @property {AbortSignal} [signal] ends the work
 * @property {number} [maxShDegree] leave out SH coefficients of higher degrees
 * @property {number[]} [box] leave out splats whose centres lie outside of x0, y0, z0, x1, y1, z1
 * @property {number} [level] of detail, 0 (the finest) if not given
 * @property {boolean} [trust] whether the file may hold more splats a byte than a real scene does
 * @property {number} [workers] how many decode; 0: none but this thread. If not given, small scenes are decoded in this
 *   thread, larger ones by at most 4 workers where there are such; by 2 where each would have the whole file
 * @property {{general?: import('./engine.js').Wasm, simd?: import('./engine.js').Wasm | null}} [wasm] the two builds, if they
 *   are not beside this module
 */

/** Bundles that are decoded until this thread does something else, and in a worker: it has memory for so many. */
const AT_A_TIME = 16, A_JOB = 4;
/** Splats of a scene that is worth a worker's start. */
const SMALL = 1 << 17;

/**
 * Decodes a file.
 * @param {ArrayBuffer | ArrayBufferView | Blob | Response | URL | string} source the file, or where it is
 * @param {Options} [options]
 * @returns {Promise<Scene>}
 * @throws {PotrError} it cannot be read, is damaged, or has no such level or degree; signal's reason: it was aborted
 */
export async function decode(source, options = {}) {
  const { onBlock, signal, maxShDegree, level = 0, trust = false } = options;
  signal?.throwIfAborted();
  const box = options.box && boxOf(options.box);
  const file = await open(source, trust, signal), { header } = file;
  let metadata = {};
  const own = header.sections.find((section) => section.name === 'meta');
  if (own) metadata = parseMetadata(readSection(await file.read(header.size + own.offset, own.stored), { ...own, offset: 0 }));
  if (maxShDegree !== undefined && ![0, 1, 2, 3].includes(maxShDegree)) refuse(`SH degree ${maxShDegree} is unknown: choose 0 to 3`);
  const highest = header.blocks[0].level;
  if (!(level >= 0 && level <= highest)) refuse(`there is no level ${level}: the file has levels 0 to ${highest}`);
  const degree = Math.min(maxShDegree ?? 3, header.degree), width = 3 * (degree + 1) ** 2;
  const blocks = header.blocks.filter((block) => block.level === level && (!box || meets(box, block.box)));
  const ranges = blocks.map((block) => /** @type {[number, number]} */ ([block.offset, bytesTo(block, degree)]));
  await file.only(ranges);

  const count = blocks.reduce((sum, block) => sum + block.splats, 0);
  const { antialiased, lowPass } = header;
  /** @param {number} n */
  const empty = (n) => {
    try {
      const array = (/** @type {number} */ each) => new Float32Array(n * each);
      return { positions: array(3), scales: array(3), rotations: array(4), opacities: array(1), sh: array(width) };
    } catch {
      return refuse(`the scene needs ${((n * (11 + width) * 4) / 1e9).toFixed(1)} GB of memory, more than there is`);
    }
  };
  /** @param {Arrays} arrays @param {number} from @param {number} to */
  const part = (arrays, from, to) => {
    const { positions, scales, rotations, opacities, sh } = arrays;
    return {
      positions: positions.subarray(3 * from, 3 * to), scales: scales.subarray(3 * from, 3 * to),
      rotations: rotations.subarray(4 * from, 4 * to), opacities: opacities.subarray(from, to), sh: sh.subarray(width * from, width * to),
    };
  };
  /** @typedef {ReturnType<typeof empty>} Arrays */
  /** @type {Arrays | undefined} */
  let whole;
  /** @type {Arrays[]} */
  const parts = [];
  const number = options.workers ?? (typeof Worker === 'undefined' || count <= SMALL ? 0 : Math.max(1, Math.min(blocks.length > 2 ? 4 : 2, (navigator.hardwareConcurrency || 2) - 1)));
  const team = number ? new Pool(number, options.wasm) : new Alone(options.wasm);
  const stop = () => team.end(signal?.reason);
  signal?.addEventListener('abort', stop);
  try {
    let first = 0;
    /** @type {Promise<void>[]} */
    const running = [];
    for (const [k, block] of blocks.entries()) {
      const data = await file.read(...ranges[k]);
      signal?.throwIfAborted();
      whole ??= box ? undefined : empty(count);
      const arrays = whole ? part(whole, first, first + block.splats) : empty(block.splats), from = first;
      first += block.splats;
      const done = team.decode(block, data, degree, arrays).then(() => {
        const kept = box && !covers(box, block.box) ? inside(arrays, box, width) : arrays, n = kept.opacities.length;
        if (box) parts[k] = kept;
        if (onBlock && n) onBlock({ count: n, degree, antialiased, lowPass, block: block.number, first: from, ...kept });
      });
      running.push(done);
      done.catch(() => {}); // it is looked at below
      // As many blocks are in memory as can be worked on.
      if (running.length >= team.ahead) await running[running.length - team.ahead];
    }
    await Promise.all(running);
    await file.end();
    await team.keep();
  } finally {
    signal?.removeEventListener('abort', stop);
    team.end();
  }
  whole ??= joined(parts.filter((some) => some.opacities.length), empty);
  const n = whole.opacities.length;
  if (box && !n) refuse(`no splat lies in the box ${shown(box)}: the scene lies in ${shown(bounds(header.blocks))}`);
  return { count: n, degree, antialiased, lowPass, metadata, ...whole };
}

/** @typedef {import('./container.js').Block} Block */
/** @typedef {import('./block.js').Values & {positions: Float32Array}} All */

let blocksOpened = 0;

/** Decodes in this thread, which may do something else now and then. */
class Alone {
  ahead = 1;
  /** @type {unknown} */
  ended = undefined;

  /** @param {Options['wasm']} wasm */
  constructor(wasm) {
    this.engine = new Engine(wasm);
    this.decoder = new Decoder(this.engine);
  }

  keep() {
    return this.engine.keep();
  }

  /** @param {Block} block @param {Uint8Array} data @param {number} degree @param {All} into */
  async decode(block, data, degree, into) {
    const bundles = Math.ceil(block.splats / BUNDLE);
    await this.decoder.open(++blocksOpened, block, data, degree);
    for (let from = 0; from < bundles; from += AT_A_TIME) {
      if (from) await pause();
      if (this.ended) throw this.ended;
      await this.decoder.values(from, Math.min(from + AT_A_TIME, bundles), into, from * BUNDLE);
    }
    await pause();
    if (this.ended) throw this.ended;
    into.positions.set(await this.decoder.positions());
  }

  /** @param {unknown} [why] */
  end(why) {
    this.ended = why;
  }
}

/** Workers that share out the parts of blocks. */
class Pool {
  /** @param {number} number @param {Options['wasm']} wasm */
  constructor(number, wasm) {
    this.ahead = number + 1;
    this.members = Array.from({ length: number }, () => ({
      worker: new Worker(new URL('./potr.js', import.meta.url), { type: 'module', name: NAME }), block: 0, fail: (/** @type {unknown} */ why) => {}, spare: /** @type {any} */ (undefined),
    }));
    this.idle = [...this.members];
    /** @type {((member: Pool['members'][0]) => void)[]} */
    this.waiting = [];
    this.wasm = wasm;
    /** @type {unknown} */
    this.ended = undefined;
  }

  /** @param {Block} block @param {Uint8Array} data @param {number} degree @param {All} into */
  async decode(block, data, degree, into) {
    const id = ++blocksOpened, bundles = Math.ceil(block.splats / BUNDLE), size = block.coder ? A_JOB : bundles, jobs = [];
    for (let from = 0; from < bundles; from += size) {
      const to = Math.min(from + size, bundles), n = Math.min(to * BUNDLE, block.splats) - from * BUNDLE;
      jobs.push(this.job(id, block, data, degree, { from, to, n }, ({ values }, member) => {
        for (const [name, array] of Object.entries(values)) into[/** @type {'sh'} */ (name)].set(array, (array.length / n) * from * BUNDLE);
        member.spare = values;
      }));
    }
    jobs.push(this.job(id, block, data, degree, {}, ({ positions }) => into.positions.set(positions)));
    await Promise.all(jobs);
  }

  /**
   * @param {number} id @param {Block} block @param {Uint8Array} data @param {number} degree @param {object} what
   * @param {(answer: any, member: Pool['members'][0]) => void} take
   */
  async job(id, block, data, degree, what, take) {
    /** @type {Pool['members'][0]} */
    const member = this.idle.shift() ?? (await new Promise((resolve) => this.waiting.push(resolve)));
    if (this.ended) throw this.ended;
    const own = member.block === id ? null : data.slice();
    member.block = id;
    try {
      const answer = await new Promise((resolve, reject) => {
        member.fail = reject;
        member.worker.onmessage = ({ data: answer }) =>
          answer.error ? reject(answer.refused ? new PotrError(answer.error) : new Error(answer.error)) : resolve(answer);
        member.worker.onerror = (/** @type {ErrorEvent} */ event) => reject(new Error(event.message || 'a worker could not be started'));
        const { spare } = member, sent = [...(own ? [own] : []), ...Object.values(spare ?? {})];
        member.worker.postMessage({ ...what, degree, wasm: this.wasm, spare, ...(own && { id, block, data: own }) }, sent.map(({ buffer }) => buffer));
        member.spare = undefined;
      });
      take(answer, member);
    } finally {
      const next = this.waiting.shift();
      if (next) next(member);
      else this.idle.push(member);
    }
  }

  async keep() {}

  end(why = /** @type {unknown} */ (new Error('decoding has ended'))) {
    this.ended = why;
    for (const { worker, fail } of this.members) {
      worker.terminate();
      fail(why);
    }
  }
}

const pause = () => new Promise((resolve) => setTimeout(resolve));

// -------------------------------------------------------------------------------------------------------- boxes

/** @param {number[]} numbers */
function boxOf(numbers) {
  const box = Array.from(numbers, Number);
  if (box.length !== 6) refuse(`a box is six numbers, x0 y0 z0 x1 y1 z1, not ${box.length}`);
  if (box.some(Number.isNaN)) refuse("one of a box's six numbers is NaN: give inf or -inf where the box has no end");
  for (let k = 0; k < 3; k++) if (box[k] > box[k + 3]) refuse(`the box ends at ${'xyz'[k]} = ${box[k + 3]}, before it begins at ${box[k]}`);
  return box;
}
/** @param {number[]} a @param {number[]} b */
const meets = (a, b) => [0, 1, 2].every((k) => a[k] <= b[k + 3] && b[k] <= a[k + 3]);
/** @param {number[]} a @param {number[]} b */
const covers = (a, b) => [0, 1, 2].every((k) => a[k] <= b[k] && b[k + 3] <= a[k + 3]);
/** @param {Block[]} blocks */
const bounds = (blocks) => blocks[0].box.map((_, k) => Math[k < 3 ? 'min' : 'max'](...blocks.map((block) => block.box[k])));

/** With four digits, as Python does. @param {number[]} box */
function shown(box) {
  const number = (/** @type {number} */ x) => {
    if (!isFinite(x)) return x < 0 ? '-inf' : 'inf';
    const [digits, exponent] = x.toExponential(3).split('e');
    return +exponent < -4 || +exponent > 3 ? `${+digits}e${exponent.replace(/([+-])(\d)$/, '$10$2')}` : '' + +x.toPrecision(4);
  };
  return [0, 1, 2].map((k) => `[${number(box[k])}, ${number(box[k + 3])}]`).join(' x ');
}

/** Those of some splats that lie in a box. @param {All} arrays @param {number[]} box @param {number} width */
function inside(arrays, box, width) {
  const corners = box.map(Math.fround), { positions } = arrays;
  const kept = Int32Array.from(arrays.opacities, (_, i) => i).filter((i) => [0, 1, 2].every((k) => positions[3 * i + k] >= corners[k] && positions[3 * i + k] <= corners[k + 3]));
  /** @param {Float32Array} array @param {number} each */
  const some = (array, each) => {
    const out = new Float32Array(kept.length * each);
    kept.forEach((from, to) => out.set(array.subarray(each * from, each * from + each), each * to));
    return out;
  };
  return { positions: some(positions, 3), scales: some(arrays.scales, 3), rotations: some(arrays.rotations, 4), opacities: some(arrays.opacities, 1), sh: some(arrays.sh, width) };
}

/** @template {All} T @param {All[]} parts @param {(n: number) => T} empty */
function joined(parts, empty) {
  const out = empty(parts.reduce((sum, part) => sum + part.opacities.length, 0));
  let at = 0;
  for (const part of parts) {
    const n = part.opacities.length;
    for (const name of /** @type {(keyof All)[]} */ (Object.keys(out))) out[name].set(part[name], (part[name].length / n) * at);
    at += n;
  }
  return out;
}
