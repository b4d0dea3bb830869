// Every golden file decodes to the singles that tests/data/golden_bits.json names, by either build.

import assert from 'node:assert/strict';
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { BUILDS, DATA, decode } from './decoders.mjs';

const BITS = JSON.parse(readFileSync(new URL('golden_bits.json', DATA), 'utf-8'));
const NAMES = { means: 'positions', log_scales: 'scales', quaternions: 'rotations', opacity_logits: 'opacities', sh: 'sh' };

/** @param {Float32Array} array */
const sha256 = (array) => createHash('sha256').update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength)).digest('hex');

for (const [name, bits] of Object.entries(BITS))
  for (const [build, wasm] of Object.entries(BUILDS))
    test(`${name}, ${build}`, async () => {
      const scene = await decode(readFileSync(new URL(`${name}.potr`, DATA)), { wasm });
      const found = Object.fromEntries(Object.entries(NAMES).map(([theirs, ours]) => [theirs, sha256(scene[ours])]));
      assert.deepEqual(found, bits);
    });

test('files that are decoded at the same time, and after one that is damaged', async () => {
  const { 'with SIMD': wasm } = BUILDS, names = Object.keys(BITS), read = (name) => readFileSync(new URL(`${name}.potr`, DATA));
  for (let round = 0; round < 2; round++) {
    const damaged = read('golden_bundles_degree3');
    damaged[damaged.length - 1] ^= 1;
    const [broken, ...scenes] = await Promise.allSettled([decode(damaged, { wasm }), ...names.map((name) => decode(read(name), { wasm }))]);
    assert.equal(broken.status, 'rejected');
    scenes.forEach(({ value }, k) => assert.equal(sha256(value.sh), BITS[names[k]].sh, names[k]));
  }
});
