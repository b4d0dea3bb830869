// The viewer in a page that encode makes: three.js, the decoder and a scene in one file. Drag to turn, pinch or wheel to go
// nearer, right drag or two fingers to move; W A S D Q E and the arrow keys fly.

import { Color, LinearSRGBColorSpace, PerspectiveCamera, Scene, Vector3, WebGPURenderer } from 'three/webgpu';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import { decode } from 'potr';
import general from '../../dist/potr.wasm';
import simd from '../../dist/potr-simd.wasm';
import { geometryOf } from '../../loaders/three.js';

const say = (words) => (document.getElementById('words').textContent = words);
const content = (id) => Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));

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
  const splats = await decode(content('scene'), { wasm: { general, simd }, workers: 0 });
  const { centre, reach } = middle(splats), view = about.view;
  const renderer = new WebGPURenderer({ antialias: false });
  // Colours of splats are those of the screen already: nothing is to be made of them.
  renderer.outputColorSpace = LinearSRGBColorSpace;
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  document.body.append(renderer.domElement);
  await renderer.init();
  const scene = new Scene(), camera = new PerspectiveCamera(view?.fov ?? 50, 1, reach / 200, reach * 200);
  scene.background = new Color(about.background ?? '#000');
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

show(JSON.parse(document.getElementById('about').textContent)).catch((error) => {
  document.body.dataset.failed = error.message;
  say(`This scene cannot be shown: ${error.message}`);
});
