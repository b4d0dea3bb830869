"""What a sweep measures while splats go and colours change, to compare other sweeps with: :class:`Course`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from potr_cl.model.scene import Scene
from potr_cl.stages.pruning.removal import RemovalSweep


@dataclass(frozen=True)
class Course:
    """An eighth of the splats goes four times, and colours change once.

    Attributes:
        steps: splats that are left, their effects and importances, which of them go, and new colours or None.
        importances: of each view at the end.
    """

    steps: Sequence[tuple[Any, ...]]
    importances: Sequence[Any]

    @classmethod
    def of(cls, removal: RemovalSweep, scene: Scene) -> Course:
        """Go it."""
        steps, rng = [], np.random.default_rng(1)
        for step in range(4):
            effects, left = removal.measure(), np.flatnonzero(removal.alive)
            gone = rng.choice(left, len(left) // 8, replace=False)
            sh = scene.sh + rng.normal(0, 0.05, scene.sh.shape).astype(np.float32) if step == 1 else None
            steps.append((left, [each[left].copy() for each in effects], gone, sh))
            removal.remove(gone)
            if sh is not None:
                removal.replace_sh(sh)
        return cls(steps, list(removal.view_importances()))

    def check(self, removal: RemovalSweep) -> None:
        """Go it again: the bits are the same."""
        for left, effects, gone, sh in self.steps:
            found = removal.measure()
            assert np.array_equal(left, np.flatnonzero(removal.alive))
            assert all(np.array_equal(a, b[left]) for a, b in zip(effects, found, strict=True))
            assert np.count_nonzero(found[1]) > 100
            removal.remove(gone)
            if sh is not None:
                removal.replace_sh(sh)
        for a, b in zip(self.importances, removal.view_importances(), strict=True):
            assert a[0] == b[0]
            assert np.array_equal(a[1], b[1])
            assert np.array_equal(a[2], b[2])
