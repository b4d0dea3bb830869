// Says what becomes of files: `node judge.mjs general|simd FILE…` prints a JSON array, of each file the words of its
// refusal or the SHA-256 of its arrays.

import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';

import { BUILDS, PotrError, decode } from './decoders.mjs';

const [build, ...files] = process.argv.slice(2), wasm = BUILDS[build === 'simd' ? 'with SIMD' : 'without SIMD'], answers = [];
for (const file of files)
  try {
    const scene = await decode(readFileSync(file), { wasm }), hash = createHash('sha256');
    for (const name of ['positions', 'scales', 'rotations', 'opacities', 'sh']) hash.update(new Uint8Array(scene[name].buffer));
    answers.push(hash.digest('hex'));
  } catch (error) {
    if (!(error instanceof PotrError)) throw error;
    answers.push(error.message);
  }
console.log(JSON.stringify(answers));
