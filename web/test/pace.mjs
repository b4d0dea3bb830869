// Decodes a file again and again: `node pace.mjs general|simd FILE ROUNDS` answers each line of its input with the seconds of
// CPU time and of wall time that a decode took, and at the end with the memory that it had at most.

import { readFileSync } from 'node:fs';
import { createInterface } from 'node:readline';

import { BUILDS, decode } from './decoders.mjs';

const [build, file] = process.argv.slice(2), wasm = BUILDS[build === 'simd' ? 'with SIMD' : 'without SIMD'], data = readFileSync(file);
for await (const line of createInterface({ input: process.stdin })) {
  if (line === 'memory') {
    console.log(JSON.stringify({ peak: process.resourceUsage().maxRSS * 1024 }));
    continue;
  }
  globalThis.gc?.();
  const cpu = process.cpuUsage(), wall = performance.now(), scene = await decode(data, { wasm, workers: 0 });
  const { user, system } = process.cpuUsage(cpu);
  console.log(JSON.stringify({ splats: scene.count, degree: scene.degree, cpu: (user + system) / 1e6, wall: (performance.now() - wall) / 1e3 }));
}
