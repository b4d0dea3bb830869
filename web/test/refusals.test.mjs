// Changed files are refused in Python's words, or decode to finite numbers; nothing else happens to them.

import assert from 'node:assert/strict';
import { readFileSync, readdirSync } from 'node:fs';
import { test } from 'node:test';
import { crc32 } from 'node:zlib';

import { BUILDS, DATA, PotrError, decode } from './decoders.mjs';

const GOLDEN = readdirSync(DATA).filter((name) => /^golden.*\.potr$/.test(name)).sort();
const read = (name) => new Uint8Array(readFileSync(new URL(name, DATA)));
const ROUNDS = Number(process.env.POTR_FUZZ ?? 12);

/** Numbers that are the same every time (mulberry32). */
function numbers(seed) {
  return (below) => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) % below;
  };
}

/** Makes all checksums right again, so that what they would find reaches the decoder. */
function mended(data) {
  const view = new DataView(data.buffer), size = view.getUint32(12, true);
  if (size > data.length || size < 36) return data;
  let at = 32, offset = size;
  const entries = (number) => {
    for (; number-- > 0 && at + 16 <= size - 4; at += 16) {
      const stored = view.getUint32(at + 4, true);
      view.setUint32(at + 12, crc32(data.subarray(offset, offset + stored)), true);
      offset += stored;
    }
  };
  entries(data[29]);
  for (let k = 0; k < view.getUint32(24, true) && at + 76 <= size - 4; k++) {
    at += 76;
    entries(data[at - 73]);
  }
  view.setUint32(size - 4, crc32(data.subarray(0, size - 4)), true);
  return data;
}

async function judged(data, wasm) {
  try {
    const scene = await decode(data, { wasm });
    for (const name of ['positions', 'scales', 'rotations', 'opacities', 'sh'])
      assert.ok(scene[name].every(Number.isFinite), `${name} of a changed file are not finite`);
    return null;
  } catch (error) {
    if (!(error instanceof PotrError)) throw error;
    assert.match(error.message, /^[^\n]+$/);
    return error.message;
  }
}

for (const [build, wasm] of Object.entries(BUILDS))
  for (const name of GOLDEN)
    test(`${name}, changed ${ROUNDS} times, ${build}`, async () => {
      const sound = read(name), below = numbers(GOLDEN.indexOf(name) + 1);
      let refused = 0;
      for (let round = 0; round < ROUNDS; round++) {
        let data = sound.slice();
        const place = below(4) ? below(data.length) : below(Math.min(data.length, 256));
        for (let k = below(3) + 1; k--; ) data[(place + below(16)) % data.length] = below(2) ? below(256) : [0, 1, 127, 128, 255][below(5)];
        if (!below(8)) data = data.slice(0, below(data.length));
        refused += (await judged(below(4) ? mended(data) : data, wasm)) !== null;
      }
      assert.ok(refused > 0, 'no change was noticed');
    });

test('words of refusals', async () => {
  const { 'without SIMD': wasm } = BUILDS, sound = read('golden_bundles_degree3.potr');
  const changed = (change) => {
    const data = sound.slice();
    return change(data) ?? data;
  };
  const cases = [
    [new Uint8Array(0), 'the file is empty'],
    [new TextEncoder().encode('ply\nformat'), "not a .potr file (its first bytes are not 'POTR'); scenes of other formats are read by convert"],
    [changed((d) => d.subarray(0, 20)), 'truncated: 20 bytes do not even hold the header'],
    [changed((d) => void (d[4] = 10)), 'the file was changed in transfer (line ends were converted): copy it again as binary'],
    [changed((d) => void (d[8] = 2)), 'format version 2, this potr_cl reads version 1: update potr_cl'],
    [changed((d) => void (d[40] ^= 1)), 'the header is damaged (its checksum does not match): get the file again'],
    [changed((d) => d.subarray(0, d.length - 7)), `truncated: the file has ${sound.length - 7} bytes, its header says ${sound.length}`],
    [changed((d) => void (d[d.length - 1] ^= 1)), "section 'sh3' is damaged (its checksum does not match): get the file again"],
    [changed((d) => mended(Object.assign(d, { 10: 2 }))), 'a file with flags 2 and quantiser 1 is unknown: update potr_cl'],
  ];
  for (const [data, words] of cases) assert.equal(await judged(data, wasm), words);
});

test('wishes that no file fulfils', async () => {
  const { 'without SIMD': wasm } = BUILDS, data = read('golden_levels.potr');
  await assert.rejects(decode(data, { wasm, maxShDegree: 4 }), { message: 'SH degree 4 is unknown: choose 0 to 3' });
  await assert.rejects(decode(data, { wasm, level: 9 }), /^PotrError: there is no level 9: the file has levels 0 to \d$/);
  await assert.rejects(decode(data, { wasm, box: [1e6, 1e6, 1e6, 2e6, 2e6, 2e6] }), /no splat lies in the box \[1e\+06, 2e\+06\] x .*: the scene lies in \[/);
  await assert.rejects(decode(data, { wasm, box: [0, 0] }), { message: 'a box is six numbers, x0 y0 z0 x1 y1 z1, not 2' });
});
