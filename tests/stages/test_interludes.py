"""Work of other stages while splats are being removed: the colours that they are given, and what becomes of theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.camera import train_views
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Interlude, Stage, State, Workbench


@dataclass(frozen=True)
class Brighter(Stage):
    """Doubles the DC terms."""

    name = "brighter"
    title = ""

    def run(self, state, bench):
        assert state.importances is not None
        sh = state.scene.sh.copy()
        sh[:, 0] *= 2
        return state.recoloured(sh)


@pytest.fixture(scope="module")
def state(plush_excerpt, plush_excerpt_cameras):
    return State.of(plush_excerpt, train_views(plush_excerpt_cameras)[:3])


def pruned(device, state, *interludes):
    bench = Workbench(HyperParameters.from_quality(0.5, "best"), device=device, interludes=interludes)
    return Prune(iterations=4).run(state, bench)


@pytest.mark.parametrize(("afresh", "factor"), [(False, 4), (True, 2)])
def test_an_interlude_gets_the_colours_of_the_one_before_or_the_first(usual_device, state, afresh, factor):
    after = pruned(usual_device, state, Interlude(1, Brighter()), Interlude(2, Brighter(), afresh=afresh))
    assert len(after.scene) < len(state.scene)
    assert np.array_equal(after.scene.sh[:, 0], factor * state.scene.sh[after.survivors, 0])


def test_the_compaction_keeps_what_a_stage_before_has_done_to_the_colours(usual_device, state):
    grey = state.recoloured(np.repeat(state.scene.sh[:, :4, :1], 3, axis=2))
    compacted = pruned(usual_device, grey, *Compact().interludes(4))
    assert compacted.scene.sh_degree == 1
    dc = compacted.scene.sh[:, 0]
    assert np.allclose(dc, dc[:, :1], atol=1e-4)  # still grey
    assert compacted.results.compacted
