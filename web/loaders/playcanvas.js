// .potr files in PlayCanvas (2.20 and newer): app.loader.getHandler('gsplat').addParser(new PotrParser(app)).
//
// Its resource keeps colours, opacities and shapes as half floats, and SH coefficients in 10 or 11 bits. Whether a scene is
// antialiased is the component's to be told (`GSplatComponentSystem`): asset.resource.antialiased says it.

import { GSplatData, GSplatResource } from 'playcanvas';
import { decode } from 'potr';

export class PotrParser {
  /** @param {import('playcanvas').AppBase} app @param {import('potr').Options} [options] */
  constructor(app, options) {
    this.app = app;
    this.options = options;
  }

  canParse({ ext }) {
    return ext === 'potr';
  }

  load(url, callback, asset) {
    const place = typeof url === 'string' ? url : url.load;
    decode(asset?.file?.contents ?? place, this.options).then((splats) => {
      const data = dataOf(splats);
      asset?.fire('load:data', data);
      callback(null, Object.assign(new GSplatResource(this.app.graphicsDevice, data), { antialiased: splats.antialiased }));
    }, callback);
  }

  open(url, data) {
    return data;
  }
}

/** @param {import('potr').Splats} splats */
export function dataOf({ count, degree, positions, scales, rotations, opacities, sh }) {
  const rest = (degree + 1) ** 2 - 1, width = 3 * (rest + 1), properties = [];
  const add = (name, array, each, from) => properties.push({ name, type: 'float', byteSize: 4, storage: Float32Array.from({ length: count }, (_, i) => array[each * i + from]) });
  ['x', 'y', 'z'].forEach((name, k) => add(name, positions, 3, k));
  [0, 1, 2].forEach((k) => add(`f_dc_${k}`, sh, width, k));
  for (let c = 0; c < 3; c++) for (let m = 0; m < rest; m++) add(`f_rest_${c * rest + m}`, sh, width, 3 * (m + 1) + c);
  add('opacity', opacities, 1, 0);
  [0, 1, 2].forEach((k) => add(`scale_${k}`, scales, 3, k));
  [0, 1, 2, 3].forEach((k) => add(`rot_${k}`, rotations, 4, k));
  return new GSplatData([{ name: 'vertex', count, properties }]);
}
