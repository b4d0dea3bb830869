// The C as WebAssembly: two builds of the same sources. The general one needs no SIMD, and takes every file; the one with
// SIMD is faster, and takes those whose integers are as narrow as real ones, in bundles.

/** @typedef {string | URL | BufferSource | WebAssembly.Module} Wasm */

/** Whether WebAssembly has vectors here. */
const SIMD = WebAssembly.validate(
  new Uint8Array([0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11]));

/** @param {Wasm} wasm */
async function compiled(wasm) {
  if (wasm instanceof WebAssembly.Module) return wasm;
  if (typeof wasm !== 'string' && !(wasm instanceof URL)) return WebAssembly.compile(wasm);
  if (wasm instanceof URL && wasm.protocol === 'file:' && 'process' in globalThis) {
    const files = 'node:fs/promises'; // nothing for bundlers
    return WebAssembly.compile(await (await import(/* @vite-ignore */ files)).readFile(wasm));
  }
  return WebAssembly.compile(await (await fetch(wasm)).arrayBuffer());
}

/** @typedef {Record<string, any>} Exports */
/**
 * What is kept of a build in this thread: its code, and an instance that nobody uses.
 * @typedef {{module: Promise<WebAssembly.Module>, idle?: Exports}} Build
 */
/** @type {Map<unknown, Build>} by address, or by what was given instead */
const builds = new Map();
/** An instance that has taken more memory than this is not kept, bytes. */
const KEPT = 1 << 26;

/** @param {Wasm} wasm @returns {Build} */
function buildOf(wasm) {
  const key = wasm instanceof URL ? wasm.href : wasm;
  let build = builds.get(key);
  if (!build) {
    build = { module: compiled(wasm) };
    builds.set(key, build);
    build.module.catch(() => builds.delete(key));
  }
  return build;
}

/** The builds of the C for one decode. */
export class Engine {
  /** @param {{general?: Wasm, simd?: Wasm | null}} [wasm] where the builds are; no simd: null */
  constructor(wasm = {}) {
    this.wasm = wasm;
    /** @type {Map<Build, Promise<Exports>>} */
    this.loaded = new Map();
  }

  /** The C of a build, loaded when it is first asked for. @param {boolean} general @returns {Promise<Exports>} */
  load(general) {
    const simd = this.wasm.simd === undefined ? new URL('./potr-simd.wasm', import.meta.url) : this.wasm.simd;
    const fast = !general && SIMD && simd, build = buildOf(fast || (this.wasm.general ?? new URL('./potr.wasm', import.meta.url)));
    const { idle } = build;
    let loaded = this.loaded.get(build);
    if (!loaded) {
      loaded = idle ? Promise.resolve(idle) : build.module.then(async (module) => (await WebAssembly.instantiate(module)).exports);
      build.idle = undefined;
      this.loaded.set(build, loaded);
    }
    return loaded;
  }

  /** Leaves the instances, with their memory, to the next decode in this thread. */
  async keep() {
    for (const [build, loaded] of this.loaded) {
      const exports = await loaded;
      if (exports.memory.buffer.byteLength <= KEPT) build.idle = exports;
    }
    this.loaded.clear();
  }
}
