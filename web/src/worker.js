// A worker of the pool: decodes parts of blocks, of the one that it was sent last.

import { Decoder } from './block.js';
import { PotrError } from './container.js';
import { Engine } from './engine.js';

export const NAME = 'potr-decoder';

export function serve() {
  /** @type {Decoder} */
  let decoder;
  /** @type {{id: number, block: any, data: Uint8Array, degree: number}} */
  let opened;
  onmessage = async ({ data: job }) => {
    try {
      decoder ??= new Decoder(new Engine(job.wasm));
      if (job.data) opened = job;
      await decoder.open(opened.id, opened.block, opened.data, opened.degree);
      if (job.to === undefined) {
        const positions = (await decoder.positions()).slice();
        postMessage({ positions }, { transfer: [positions.buffer] });
      } else {
        const { n, degree, spare } = job;
        // Memory goes back and forth: what is given up is only collected much later.
        const array = (/** @type {string} */ name, /** @type {number} */ each) =>
          spare?.[name].buffer.byteLength >= 4 * each * n ? new Float32Array(spare[name].buffer, 0, each * n) : new Float32Array(each * n);
        const values = { scales: array('scales', 3), rotations: array('rotations', 4), opacities: array('opacities', 1), sh: array('sh', 3 * (degree + 1) ** 2) };
        await decoder.values(job.from, job.to, values, 0);
        postMessage({ values }, { transfer: Object.values(values).map((array) => array.buffer) });
      }
    } catch (error) {
      postMessage({ error: /** @type {Error} */ (error).message, refused: error instanceof PotrError });
    }
  };
}
