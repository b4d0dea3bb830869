// Decodes a file again and again: `node pace.mjs general|simd FILE ROUNDS` answers each line of its input with the seconds of
// CPU time and of wall time that a decode took; "memory" with the memory that it had at most; and a number with the wall time
// that the file takes from a server that sends so many Mbit/s.

import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { createInterface } from 'node:readline';

import { BUILDS, decode } from './decoders.mjs';

const [build, file] = process.argv.slice(2), wasm = BUILDS[build === 'simd' ? 'with SIMD' : 'without SIMD'], data = readFileSync(file);

/** Seconds from the request until a file from a slow server is decoded. @param {number} rate Mbit/s */
async function over(rate) {
  const server = createServer((_, response) => {
    const begin = performance.now();
    let at = 0;
    const send = () => {
      const to = Math.min(data.length, Math.floor(((performance.now() - begin) / 8) * rate * 1000));
      response.write(data.subarray(at, to));
      at = to;
      if (at < data.length) setTimeout(send, 10);
      else response.end();
    };
    setTimeout(send, 10);
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  const begin = performance.now();
  await decode(`http://127.0.0.1:${server.address().port}/`, { wasm });
  const seconds = (performance.now() - begin) / 1e3;
  server.close();
  return seconds;
}

for await (const line of createInterface({ input: process.stdin })) {
  if (line === 'memory') {
    console.log(JSON.stringify({ peak: process.resourceUsage().maxRSS * 1024 }));
    continue;
  }
  if (+line) {
    console.log(JSON.stringify({ seconds: await over(+line) }));
    continue;
  }
  globalThis.gc?.();
  const cpu = process.cpuUsage(), wall = performance.now(), scene = await decode(data, { wasm, workers: 0 });
  const { user, system } = process.cpuUsage(cpu);
  console.log(JSON.stringify({ splats: scene.count, degree: scene.degree, cpu: (user + system) / 1e6, wall: (performance.now() - wall) / 1e3 }));
}
