// The viewer in a page that encode makes: three.js, the decoder and a scene in one file. Drag to turn, pinch or wheel to go
// nearer, right drag or two fingers to move; W A S D Q E and the arrow keys fly.
//
// The page of potr_cl's viewer loads it, too; its camera and controls are its own, and `potr.drawing` draws for it.

import { Color, LinearSRGBColorSpace, PerspectiveCamera, Quaternion, Scene, Vector3, WebGPURenderer } from 'three/webgpu';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import { decode } from 'potr';
import general from '../../dist/potr.wasm';
import simd from '../../dist/potr-simd.wasm';
import { geometryOf } from '../../loaders/three.js';

const say = (words) => (document.getElementById('words').textContent = words);
const content = (id) => Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));

/** @param {HTMLCanvasElement} [canvas] @param {string} [background] */
async function rendererOn(canvas, background = '#000') {
  const renderer = new WebGPURenderer({ canvas, antialias: false });
  // Colours of splats are those of the screen already: nothing is to be made of them.
  renderer.outputColorSpace = LinearSRGBColorSpace;
  renderer.setClearColor(new Color().setStyle(background, LinearSRGBColorSpace));
  await renderer.init();
  return renderer;
}

/** @param {Uint8Array} potr @param {object} [options] */
const decoded = (potr, options) => decode(potr, { wasm: { general, simd }, workers: 0, ...options });

/**
 * Draws scenes for a page that has a camera of its own.
 * @param {HTMLCanvasElement} canvas @param {string} background @param {() => void} lost told when the GPU is gone
 */
async function drawing(canvas, background, lost) {
  const renderer = await rendererOn(canvas, background), camera = new PerspectiveCamera(50, 1, 0.2, 1e6), shown = {};
  renderer.onDeviceLost = lost;
  renderer.autoClear = false;
  return {
    /** Puts a scene, or nothing, in the place of another. @param {string} name @param {Uint8Array} [potr] */
    async put(name, potr) {
      const splats = potr && new GaussianSplat(geometryOf(await decoded(potr, { trust: true }))), old = shown[name]?.children[0];
      shown[name] = splats && new Scene().add(splats);
      old?.geometry.dispose();
      old?.material.dispose();
    },
    /**
     * @param {{position: number[], wxyz: number[], fov: number, image_width: number, image_height: number}} view axes as in OpenCV
     * @param {[name: string, left: number, right: number, from: number, to: number][]} parts of the width that each scene
     *   fills, and of those the parts that show
     */
    draw({ position, wxyz: [w, x, y, z], fov, image_width: width, image_height: height }, parts) {
      renderer.setSize(width, height, false);
      camera.position.fromArray(position);
      camera.quaternion.set(x, y, z, w).multiply(OVER);
      camera.fov = (fov * 180) / Math.PI;
      renderer.setScissorTest(false);
      renderer.clear();
      renderer.setScissorTest(true);
      for (const [name, left, right, from, to] of parts) {
        const [x0, x1, x2, x3] = [left, right, from, to].map((part) => Math.round(part * width));
        if (x3 <= x2) continue;
        camera.aspect = (x1 - x0) / height;
        camera.updateProjectionMatrix();
        renderer.setViewport(x0, 0, x1 - x0, height);
        renderer.setScissor(x2, 0, x3 - x2, height);
        renderer.render(shown[name], camera);
      }
    },
  };
}
/** From the axes of OpenCV's cameras to those of three.js. */
const OVER = new Quaternion(1, 0, 0, 0);

/** Where most splats are: the median of their places, and the distance within which 3 of 4 lie. */
function middle({ count, positions }) {
  const step = Math.max(1, Math.floor(count / 20000)), some = Array.from({ length: Math.ceil(count / step) }, (_, k) => k * step);
  const rank = (values, part) => values.sort((a, b) => a - b)[Math.floor((values.length - 1) * part)];
  const centre = new Vector3(...[0, 1, 2].map((axis) => rank(some.map((i) => positions[3 * i + axis]), 0.5)));
  const reach = rank(some.map((i) => centre.distanceTo(new Vector3(...positions.subarray(3 * i, 3 * i + 3)))), 0.75);
  return { centre, reach: reach || 1 };
}

/** @param {{view?: {position: number[], target: number[], up: number[], fov: number}}} about */
async function show(about) {
  const splats = await decoded(content('scene'));
  const { centre, reach } = middle(splats), view = about.view;
  const renderer = await rendererOn();
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  document.body.append(renderer.domElement);
  const scene = new Scene(), camera = new PerspectiveCamera(view?.fov ?? 50, 1, reach / 200, reach * 200);
  camera.up.set(...(view?.up ?? [0, -1, 0]));
  camera.position.set(...(view?.position ?? [centre.x, centre.y, centre.z - 3 * reach]));
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.enableDamping = true;
  controls.target.set(...(view?.target ?? centre.toArray()));
  scene.add(new GaussianSplat(geometryOf(splats)));
  const fit = () => {
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
    renderer.setSize(innerWidth, innerHeight);
  };
  addEventListener('resize', fit);
  fit();

  const held = new Set(), keys = { KeyW: [2, -1], ArrowUp: [2, -1], KeyS: [2, 1], ArrowDown: [2, 1], KeyA: [0, -1], ArrowLeft: [0, -1], KeyD: [0, 1], ArrowRight: [0, 1], KeyQ: [1, -1], KeyE: [1, 1] };
  addEventListener('keydown', ({ code, ctrlKey, metaKey }) => ctrlKey || metaKey || held.add(code));
  addEventListener('keyup', ({ code }) => held.delete(code));
  addEventListener('blur', () => held.clear());
  let before = performance.now(), frames = 0;
  renderer.setAnimationLoop((now) => {
    const pace = (reach * Math.min(now - before, 100)) / 1500, along = new Vector3();
    before = now;
    for (const code of held)
      if (keys[code]) along.add(new Vector3().setFromMatrixColumn(camera.matrix, keys[code][0]).multiplyScalar(keys[code][1] * pace));
    camera.position.add(along);
    controls.target.add(along);
    controls.update();
    renderer.render(scene, camera);
    if (++frames === 2) document.body.dataset.shown = String(splats.count);
  });
  globalThis.potr = { camera, controls, renderer, scene, splats };
  say(about.words ?? '');
}

const about = document.getElementById('about');
if (about)
  show(JSON.parse(about.textContent)).catch((error) => {
    document.body.dataset.failed = error.message;
    say(`This scene cannot be shown: ${error.message}`);
  });
else globalThis.potr = { drawing };
