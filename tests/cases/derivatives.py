"""What derivatives of pictures are tried with: :func:`case_of_derivatives`."""

from __future__ import annotations

import dataclasses

import numpy as np

from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene


def case_of_derivatives(degree, antialiased):
    """A scene, its views, and what each pixel's derivative is multiplied by.

    Some splats are capped, some colours cut at 0, one splat is behind a camera, one beyond the clamp of x/z, one
    transparent. Views differ in size, and do not end where tiles do.
    """
    scene = dataclasses.replace(visible_scene(60, degree, seed=degree), antialiased=antialiased)
    scene.opacity_logits[:6] = 7
    scene.opacity_logits[6] = -9
    scene.sh[:8, 0] -= 3
    cameras = [*ring_of_cameras(4, size=40)[:2], tilted_camera(3, 33, 50)]
    scene.means[9] = 2 * cameras[0].centre
    scene.means[10] = cameras[1].rotation.T @ (np.array([2.2, 0.3, 2.5]) - cameras[1].translation)
    scene.log_scales[10] = 0
    rng = np.random.default_rng(degree)
    return scene, cameras, [rng.normal(size=(c.height, c.width, 3)) for c in cameras]
