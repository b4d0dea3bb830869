// Lets splat-transform (2.7 and newer) read .potr files, and so turn them into all that it writes:
//
//     splat-transform potr/dist/loaders/splat-transform.mjs -p file=scene.potr scene.sog
//
// Also: degree=… leaves out SH coefficients of higher degrees. Values go through as they are; its formats know nothing of
// antialiased scenes.

import { readFile } from 'node:fs/promises';

import { decode } from '../potr.js';

export class Generator {
  /** @param {{name: string, value: string}[] | Record<string, string>} params */
  static async create(params) {
    const given = Array.isArray(params) ? Object.fromEntries(params.map(({ name, value }) => [name, value])) : params;
    if (!given.file) throw new Error('give the .potr file: -p file=scene.potr');
    const { count, degree, positions, scales, rotations, opacities, sh } = await decode(await readFile(given.file), { maxShDegree: given.degree ? +given.degree : undefined });
    const rest = (degree + 1) ** 2 - 1, width = 3 * (rest + 1);
    const columns = [
      ...['x', 'y', 'z'].map((name, k) => [name, positions, 3, k]), ...[0, 1, 2].map((k) => [`f_dc_${k}`, sh, width, k]),
      ...Array.from({ length: 3 * rest }, (_, k) => [`f_rest_${k}`, sh, width, 3 * ((k % rest) + 1) + Math.floor(k / rest)]),
      ['opacity', opacities, 1, 0], ...[0, 1, 2].map((k) => [`scale_${k}`, scales, 3, k]), ...[0, 1, 2, 3].map((k) => [`rot_${k}`, rotations, 4, k]),
    ];
    return {
      count,
      columnNames: columns.map(([name]) => name),
      getRow(index, row) {
        for (const [name, array, each, from] of columns) row[name] = array[each * index + from];
      },
    };
  }
}
