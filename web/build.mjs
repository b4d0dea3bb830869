// Bundles the package: `npm run build`, after the C has been compiled (python -m tools.make.web does both).

import { writeFileSync } from 'node:fs';

import { build } from 'esbuild';
import { minify } from 'terser';

/** @param {string} name @param {object} options of esbuild */
async function bundle(name, options = {}) {
  const { outputFiles } = await build({
    entryPoints: [`src/${name}`], bundle: true, write: false, format: 'esm', target: 'es2022', logLevel: 'warning', ...options,
  });
  const { code } = await minify(outputFiles[0].text, { module: true, ecma: 2020, compress: { passes: 3, pure_getters: true, unsafe_arrows: true } });
  writeFileSync(`dist/${name}`, code ?? '');
}

await bundle('potr.js');
