// .potr files in three.js (r186 and newer): POTRLoader gives the geometry of its GaussianSplat.
//
// What that cannot hold: colours, opacities and SH coefficients have 8 bits each there (coefficients beyond −1 to 1 are
// clamped), and all scenes are rendered as classic ones, antialiased ones too.

import { Loader } from 'three';
import { createGaussianSplatGeometry, createPackedSphericalHarmonicsBand, sigmoid, writeColorBytesFromSH0, writeCovariance } from 'three/addons/utils/GaussianSplatUtils.js';
import { decode } from 'potr';

export class POTRLoader extends Loader {
  /** What decode is given: maxShDegree, box, workers, wasm, … */
  options = {};

  load(url, onLoad, onProgress, onError) {
    const path = this.path + url;
    this.manager.itemStart(path);
    this.read(this.withCredentials || Object.keys(this.requestHeader).length ? fetch(path, { headers: this.requestHeader, credentials: this.withCredentials ? 'include' : 'same-origin' }) : path)
      .then(onLoad)
      .catch((error) => {
        onError ? onError(error) : console.error(error);
        this.manager.itemError(path);
      })
      .finally(() => this.manager.itemEnd(path));
  }

  /** @param {ArrayBuffer} buffer @returns {Promise<import('three').BufferGeometry>} */
  parse(buffer) {
    return this.read(buffer);
  }

  async read(source) {
    return geometryOf(await decode(await source, this.options));
  }
}

/** The geometry of a decoded scene, or of a part of one. @param {import('potr').Splats} splats */
export function geometryOf({ count, degree, positions, scales, rotations, opacities, sh }) {
  const covariances = new Float32Array(6 * count), colors = new Uint8ClampedArray(4 * count), width = 3 * (degree + 1) ** 2, bands = {};
  for (let i = 0; i < count; i++) {
    const [w, x, y, z] = rotations.subarray(4 * i, 4 * i + 4);
    writeCovariance(covariances, 6 * i, Math.exp(scales[3 * i]), Math.exp(scales[3 * i + 1]), Math.exp(scales[3 * i + 2]), x, y, z, w);
    const at = i * width;
    writeColorBytesFromSH0(colors, 4 * i, sh[at], sh[at + 1], sh[at + 2], sigmoid(opacities[i]));
  }
  for (let d = 1; d <= degree; d++) {
    const { packed, bytes } = createPackedSphericalHarmonicsBand(count, d), stride = bytes.length / count;
    for (let i = 0; i < count; i++)
      for (let k = 0, from = i * width + 3 * d * d; k < 3 * (2 * d + 1); k++) bytes[i * stride + k] = 128 + 128 * sh[from + k];
    bands[`sh${d}`] = packed;
  }
  return createGaussianSplatGeometry(positions, covariances, colors, bands);
}
