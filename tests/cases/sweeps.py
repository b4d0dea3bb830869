"""Two ways to measure the same removal effects, step by step."""

from __future__ import annotations

import numpy as np

from potr_cl.model.scene import Scene
from potr_cl.stages.pruning.removal import RemovalSweep


def assert_same_bits(wanted: RemovalSweep, got: RemovalSweep, scene: Scene, rng: np.random.Generator) -> None:
    """Both measure the same while an eighth of the splats goes four times, and colours change once."""
    for step in range(4):
        effects, found = wanted.measure(), got.measure()
        left = np.flatnonzero(wanted.alive)
        assert np.array_equal(left, np.flatnonzero(got.alive))
        assert np.array_equal(effects[0][left], found[0][left])
        assert np.array_equal(effects[1][left], found[1][left])
        assert np.count_nonzero(found[1]) > 100
        gone = rng.choice(left, len(left) // 8, replace=False)
        wanted.remove(gone)
        got.remove(gone)
        if step == 1:
            sh = scene.sh + rng.normal(0, 0.05, scene.sh.shape).astype(np.float32)
            wanted.replace_sh(sh)
            got.replace_sh(sh)
    for a, b in zip(wanted.view_importances(), got.view_importances(), strict=True):
        assert a[0] == b[0]
        assert np.array_equal(a[1], b[1])
        assert np.array_equal(a[2], b[2])
