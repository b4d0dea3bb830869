// Where a file's bytes come from: memory, a body that arrives, or ranges that a server is asked for.

import { FIXED_BYTES, headerBytes, readHeader, refuse, saidBytes } from './container.js';

/** A body that is read from its beginning on; what lies before what was read last is forgotten. */
class Arriving {
  /** @param {ReadableStream<Uint8Array>} body */
  constructor(body) {
    this.reader = body.getReader();
    /** @type {Uint8Array[]} */
    this.pieces = [];
    this.begin = this.end = 0;
  }

  /** Bytes of the file, fewer where it ends. @param {number} offset at or behind what was forgotten @param {number} number */
  async read(offset, number, keep = false) {
    for (; this.end < offset + number; ) {
      const { done, value } = await this.reader.read();
      if (done) break;
      this.pieces.push(value);
      this.end += value.length;
      this.forget(offset);
    }
    const out = new Uint8Array(Math.max(Math.min(number, this.end - offset), 0));
    let at = this.begin;
    for (const piece of this.pieces) {
      const from = Math.max(offset - at, 0), some = piece.subarray(from, Math.max(from, offset + out.length - at));
      if (some.length) out.set(some, at + from - offset);
      at += piece.length;
    }
    if (!keep) this.forget(offset + number);
    return out;
  }

  /** @param {number} offset */
  forget(offset) {
    while (this.pieces.length && this.begin + this.pieces[0].length <= offset) this.begin += /** @type {Uint8Array} */ (this.pieces.shift()).length;
  }

  cancel() {
    return this.reader.cancel().catch(() => {});
  }
}

/**
 * @typedef {object} Opened
 * @property {import('./container.js').Header} header
 * @property {(offset: number, number: number) => Promise<Uint8Array>} read
 * @property {() => Promise<void>} end checks that nothing follows, where that is not known and the file's end was wanted
 * @property {(wanted: [number, number][]) => Promise<void>} only tells which ranges will be read, in their order
 */

/**
 * Opens a file: its header is verified.
 * @param {ArrayBuffer | ArrayBufferView | Blob | Response | URL | string} source
 * @param {boolean} trust
 * @param {AbortSignal} [signal]
 * @returns {Promise<Opened>}
 */
export async function open(source, trust, signal) {
  if (source instanceof Blob) source = await source.arrayBuffer();
  const url = typeof source === 'string' || source instanceof URL ? '' + source : '';
  const response = url ? await fetched(url, signal) : source instanceof Response ? source : null;
  if (!response) {
    const given = /** @type {ArrayBuffer | ArrayBufferView} */ (source);
    const bytes = ArrayBuffer.isView(given) ? new Uint8Array(given.buffer, given.byteOffset, given.byteLength) : new Uint8Array(given);
    return {
      header: readHeader(bytes, bytes.length, trust),
      read: async (offset, number) => bytes.subarray(offset, offset + number),
      end: async () => {},
      only: async () => {},
    };
  }
  if (!response.ok || !response.body) refuse(`cannot read '${url || response.url}': HTTP ${response.status}`);
  const body = new Arriving(response.body);
  const fixed = await body.read(0, FIXED_BYTES, true), whole = fixed.length === FIXED_BYTES;
  const size = headerBytes(fixed, fixed.length), said = whole ? Number(saidBytes(fixed)) : fixed.length;
  const start = await body.read(0, size, true), header = readHeader(start, start.length < size ? start.length : said, trust);
  let ranges = false, last = said;
  /** @param {number} offset @param {number} number */
  const read = async (offset, number) => {
    const bytes = ranges ? await range(url, offset, number, signal) : await body.read(offset, number);
    if (bytes.length < number) refuse(`truncated: the file has ${offset + bytes.length} bytes, its header says ${said}`);
    return bytes;
  };
  return {
    header,
    read,
    end: async () => {
      if (ranges) return;
      const more = last < said ? [] : await body.read(said, 1);
      await body.cancel();
      if (more.length) refuse(`followed by something else: the file has more than the ${said} bytes that its header says`);
    },
    only: async (wanted) => {
      last = Math.max(...wanted.map(([offset, number]) => offset + number));
      const bytes = wanted.reduce((sum, [, number]) => sum + number, 0);
      if (!url || !wanted.length || bytes > 0.75 * said) return;
      // A server that has ranges answers 206; if not, the body goes on arriving.
      const trial = await fetch(url, { signal, headers: { Range: `bytes=${wanted[0][0]}-${wanted[0][0]}` } }).catch(() => null);
      ranges = trial?.status === 206;
      await trial?.body?.cancel();
      if (ranges) await body.cancel();
    },
  };
}

/** @param {string} url @param {AbortSignal} [signal] @param {Record<string, string>} [headers] */
async function fetched(url, signal, headers) {
  try {
    return await fetch(url, { signal, headers });
  } catch (error) {
    signal?.throwIfAborted();
    return refuse(`cannot read '${url}': ${/** @type {Error} */ (error).message}`);
  }
}

/** @param {string} url @param {number} offset @param {number} number @param {AbortSignal} [signal] */
async function range(url, offset, number, signal) {
  if (!number) return new Uint8Array(0);
  const response = await fetched(url, signal, { Range: `bytes=${offset}-${offset + number - 1}` });
  if (response.status !== 206) refuse(`cannot read '${url}': HTTP ${response.status} where a range was asked for`);
  return new Uint8Array(await response.arrayBuffer());
}
