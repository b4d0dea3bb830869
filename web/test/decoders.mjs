// What is tested: the built package, and its two builds of the C.

import { readFileSync } from 'node:fs';

export const DIST = new URL(process.env.POTR_DIST ?? '../dist/', import.meta.url);
export const DATA = new URL('../../tests/data/', import.meta.url);

const wasm = (name) => new WebAssembly.Module(readFileSync(new URL(name, DIST)));
const general = wasm('potr.wasm');
export const BUILDS = { 'with SIMD': { general, simd: wasm('potr-simd.wasm') }, 'without SIMD': { general, simd: null } };

export const { decode, PotrError } = await import(new URL('potr.js', DIST));
