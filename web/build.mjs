// Bundles the package: `npm run build`, after the C has been compiled (python -m tools.make.web does both).

import { copyFileSync, mkdirSync, readFileSync, readdirSync, writeFileSync } from 'node:fs';
import { gzipSync } from 'node:zlib';

import { build } from 'esbuild';
import { minify } from 'terser';

/** What pages that encode makes are made of. */
const PAGE = '../potr_cl/formats/scenes/page.html';

/** @param {string} name @param {object} options of esbuild @returns {Promise<string>} */
async function bundled(name, options = {}) {
  const { outputFiles } = await build({ entryPoints: [name], bundle: true, write: false, format: 'esm', target: 'es2022', logLevel: 'warning', legalComments: 'none', ...options });
  const { code } = await minify(outputFiles[0].text, { module: true, ecma: 2020, compress: { passes: 2 } });
  return code ?? '';
}

mkdirSync('dist/loaders', { recursive: true });
writeFileSync('dist/potr.js', await bundled('src/potr.js'));
for (const name of readdirSync('loaders')) copyFileSync(`loaders/${name}`, `dist/loaders/${name}`);

const viewer = await bundled('src/page/viewer.js', { format: 'iife', alias: { potr: './src/potr.js' }, loader: { '.wasm': 'binary' }, define: { 'import.meta.url': '"about:blank"' } });
const page = readFileSync('src/page/page.html', 'utf-8').replace('@viewer@', () => gzipSync(viewer, { level: 9 }).toString('base64'));

writeFileSync(PAGE, page);
