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

/**
 * Gives the C of a build, loaded when it is first asked for.
 * @param {{general?: Wasm, simd?: Wasm | null}} [wasm] where the builds are; no simd: null
 * @returns {import('./block.js').Load}
 */
export function loader(wasm = {}) {
  /** @type {Promise<Record<string, any>>[]} */
  const loaded = [];
  return (general) => {
    const simd = wasm.simd === undefined ? new URL('./potr-simd.wasm', import.meta.url) : wasm.simd;
    const fast = !general && SIMD && simd;
    return (loaded[+!!fast] ??= compiled(fast || (wasm.general ?? new URL('./potr.wasm', import.meta.url))).then(
      async (module) => (await WebAssembly.instantiate(module)).exports));
  };
}
