// .potr files in Spark (2.0 and newer): loadPotr gives its PackedSplats, for `new SplatMesh({ packedSplats })`.
//
// What these cannot hold: places are half floats, so move scenes near the origin; scales, rotations, colours and opacities
// have 8 bits; SH coefficients 7, 8 and 6, within −1 to 1. Spark blurs by 0.3 pixels whatever the scene says; whether
// it is antialiased is SparkRenderer's to be told, see `antialiased`.

import { PackedSplats, utils } from '@sparkjsdev/spark';
import { decode } from 'potr';

/**
 * @param {Parameters<typeof decode>[0]} source
 * @param {import('potr').Options} [options]
 * @returns {Promise<PackedSplats & {antialiased: boolean}>}
 */
export async function loadPotr(source, options) {
  const splats = await decode(source, options);
  return Object.assign(packedOf(splats), { antialiased: splats.antialiased });
}

/** @param {import('potr').Splats} splats */
export function packedOf({ count, degree, positions, scales, rotations, opacities, sh }) {
  const size = Math.ceil(Math.max(count, 1) / 2048) * 2048, packedArray = new Uint32Array(4 * size), width = 3 * (degree + 1) ** 2, extra = {};
  const colour = (i, c) => 0.5 + 0.28209479177387814 * sh[i * width + c];
  for (let i = 0; i < count; i++)
    utils.setPackedSplat(
      packedArray, i, ...positions.subarray(3 * i, 3 * i + 3), ...scales.subarray(3 * i, 3 * i + 3).map(Math.exp),
      rotations[4 * i + 1], rotations[4 * i + 2], rotations[4 * i + 3], rotations[4 * i],
      1 / (1 + Math.exp(-opacities[i])), colour(i, 0), colour(i, 1), colour(i, 2));
  for (let d = 1; d <= degree; d++) {
    const words = new Uint32Array([0, 2, 4, 4][d] * size);
    for (let i = 0; i < count; i++) utils[`encodeSh${d}Rgb`](words, i, sh.subarray(i * width + 3 * d * d, i * width + 3 * (d + 1) ** 2));
    extra[`sh${d}`] = words;
  }
  return new PackedSplats({ packedArray, numSplats: count, extra });
}
