// Files from servers: bodies that arrive slowly, ranges, what is broken off.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { after, before, test } from 'node:test';

import { BUILDS, DATA, PotrError, decode } from './decoders.mjs';

const { 'with SIMD': wasm } = BUILDS;
const BLOCKS = new Uint8Array(readFileSync(new URL('golden_blocks.potr', DATA)));
const LEVELS = new Uint8Array(readFileSync(new URL('golden_levels.potr', DATA)));
/** The header and the coarsest level, of a single block, which comes first. */
const COARSE = 994;
const BITS = (scene) => ['positions', 'scales', 'rotations', 'opacities', 'sh'].map((name) => Buffer.from(scene[name].buffer, scene[name].byteOffset, scene[name].byteLength).toString('base64'));

let server, base;
const asked = [];
before(async () => {
  server = createServer((request, response) => {
    const path = request.url ?? '', [, from, to] = /bytes=(\d+)-(\d+)/.exec(request.headers.range ?? '') ?? [];
    asked.push([path, request.headers.range]);
    if (path === '/levels') return from ? response.writeHead(206).end(LEVELS.subarray(+from, +to + 1)) : response.writeHead(200).write(LEVELS.subarray(0, COARSE - 200));
    if (path === '/coarse') return response.writeHead(200).write(LEVELS.subarray(0, COARSE)); // and nothing more
    if (path === '/none') return response.writeHead(404).end();
    if (path === '/ranges' && from) return response.writeHead(206).end(BLOCKS.subarray(+from, +to + 1));
    let at = 0, end = path === '/short' ? BLOCKS.length - 100 : BLOCKS.length;
    response.writeHead(200);
    const send = () => {
      if (response.destroyed || path === '/stuck' && at > BLOCKS.length / 2) return;
      response.write(BLOCKS.subarray(at, Math.min(at + 1000, end)));
      at += 1000;
      if (at >= end) response.end(path === '/long' ? 'more' : undefined);
      else setTimeout(send, path === '/fast' ? 0 : 1);
    };
    send();
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  base = `http://127.0.0.1:${server.address().port}`;
});
after(() => server.closeAllConnections() ?? server.close());

test('blocks come before the file has arrived', async () => {
  const whole = await decode(BLOCKS, { wasm }), parts = [];
  const scene = await decode(`${base}/slow`, { wasm, onBlock: (part) => parts.push(part) });
  assert.deepEqual(BITS(scene), BITS(whole));
  assert.ok(parts.length > 1);
  assert.equal(parts.reduce((sum, part) => sum + part.count, 0), whole.count);
  for (const { first, count, positions } of parts) assert.deepEqual(positions, whole.positions.subarray(3 * first, 3 * (first + count)));
});

test('the first block is there while the body is still on its way', async () => {
  const controller = new AbortController(), seen = [];
  const work = decode(`${base}/stuck`, { wasm, signal: controller.signal, onBlock: (part) => { seen.push(part.block); controller.abort(); } });
  await assert.rejects(work, { name: 'AbortError' });
  assert.ok(seen.length >= 1);
});

test('a Response and a Blob', async () => {
  const whole = BITS(await decode(BLOCKS, { wasm }));
  assert.deepEqual(BITS(await decode(await fetch(`${base}/fast`), { wasm })), whole);
  assert.deepEqual(BITS(await decode(new Blob([BLOCKS]), { wasm })), whole);
});

for (const path of ['ranges', 'slow'])
  test(`a part of it, /${path}`, async () => {
    const bounds = [], whole = await decode(BLOCKS, { wasm, onBlock: ({ positions }) => bounds.push([Math.min(...positions.filter((_, i) => i % 3 === 0)), Math.max(...positions.filter((_, i) => i % 3 === 0))]) });
    const [low, high] = bounds[0], box = [low, -Infinity, -Infinity, (low + high) / 2, Infinity, Infinity];
    const local = await decode(BLOCKS, { wasm, box, maxShDegree: 0 });
    assert.ok(local.count > 0 && local.count < whole.count);
    asked.length = 0;
    assert.deepEqual(BITS(await decode(`${base}/${path}`, { wasm, box, maxShDegree: 0 })), BITS(local));
    assert.ok(path !== 'ranges' || asked.some(([, range]) => range), 'no range was asked for');
  });

test('the coarsest level is there before the others have arrived', async () => {
  const coarse = await decode(LEVELS, { wasm, level: 1 }), finest = await decode(LEVELS, { wasm });
  assert.ok(coarse.count > 0 && coarse.count < finest.count);
  assert.deepEqual(BITS(await decode(`${base}/coarse`, { wasm, level: 1 })), BITS(coarse));
});

test('of a server that has ranges, a level is all that is asked for', async () => {
  asked.length = 0;
  assert.deepEqual(BITS(await decode(`${base}/levels`, { wasm, level: 1 })), BITS(await decode(LEVELS, { wasm, level: 1 })));
  const ranges = asked.map(([, range]) => range).filter(Boolean).map((range) => range.match(/\d+/g).map(Number));
  assert.ok(ranges.length);
  assert.equal(Math.max(...ranges.flat()), COARSE - 1);
});

test('what is broken off, or goes on, or is not there', async () => {
  await assert.rejects(decode(`${base}/short`, { wasm }), new RegExp(`truncated: the file has ${BLOCKS.length - 100} bytes, its header says ${BLOCKS.length}`));
  await assert.rejects(decode(`${base}/long`, { wasm }), /followed by something else/);
  await assert.rejects(decode(`${base}/none`, { wasm }), /HTTP 404/);
  await assert.rejects(decode('http://127.0.0.1:1/x', { wasm }), PotrError);
});

test('aborted before and meanwhile', async () => {
  await assert.rejects(decode(BLOCKS, { wasm, signal: AbortSignal.abort() }), { name: 'AbortError' });
  const controller = new AbortController();
  setTimeout(() => controller.abort(), 20);
  await assert.rejects(decode(`${base}/stuck`, { wasm, signal: controller.signal }), { name: 'AbortError' });
});
