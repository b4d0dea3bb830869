"""The stage that prunes: splats that no training view sees, and work of other stages while splats are being removed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl import EncodeOptions, Scene, UsageError, decode, encode
from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.camera import train_views
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Interlude, Stage, State, Workbench
from tests.reference.surfaces import together

FEW = {"iterations": 3}


@pytest.fixture(scope="module")
def half_seen(plush_excerpt: Scene) -> Scene:
    """The excerpt, and 300 of its splats again where no camera looks."""
    beyond = plush_excerpt.subset(np.arange(0, 1500, 5))
    return together(plush_excerpt, dataclasses.replace(beyond, means=beyond.means + np.float32(30)))


@pytest.fixture(scope="module")
def both(family_device, half_seen, plush_excerpt_cameras):
    """An encode of the seen and the unseen."""
    return encode(half_seen, plush_excerpt_cameras, EncodeOptions.for_preset("fast", prune=FEW), device=family_device)


@pytest.mark.one_family
def test_they_are_kept_and_told_of(both, half_seen, plush_excerpt):
    encoded = both
    kept = encoded.order[encoded.order >= len(plush_excerpt)]
    assert sorted(kept) == list(range(1500, 1800))
    assert (encoded.unseen.splats, encoded.unseen.of, encoded.unseen.kept) == (300, 1800, True)
    assert 0.1 < encoded.unseen.area < 0.25
    assert "300 splats" in str(encoded.unseen)
    back = decode(b"".join(encoded.pieces))
    beyond = encoded.order >= len(plush_excerpt)
    assert not back.sh[beyond, 1:].any()
    np.testing.assert_allclose(back.means[beyond], half_seen.means[encoded.order[beyond]], atol=0.2)


@pytest.mark.one_family
def test_the_seen_ones_are_pruned_as_without_the_others(family_device, both, plush_excerpt, plush_excerpt_cameras):
    options = EncodeOptions.for_preset("fast", prune=FEW)
    alone = encode(plush_excerpt, plush_excerpt_cameras, options, device=family_device)
    assert sorted(both.order[both.order < len(plush_excerpt)]) == sorted(alone.order)
    assert both.pruned.kept == alone.pruned.kept + 300
    gone = 1500 - alone.pruned.kept
    order = both.pruned.order
    # Those that no view sees come after all that went, and before all others that are left.
    assert np.array_equal(order[:gone], alone.pruned.order[:gone])
    assert np.array_equal(order[gone : gone + 300], np.arange(1500, 1800))
    assert np.array_equal(order[gone + 300 :], alone.pruned.order[gone:])
    assert np.array_equal(both.importance, [*alone.importance, *[0] * 300])
    np.testing.assert_array_equal(both.pruned.survivors, np.sort(both.order))
    assert both.pruned.history[-1].left == both.pruned.kept
    assert alone.unseen.splats == 0


@pytest.mark.one_family
@pytest.mark.parametrize("prune", [{"unseen": "drop"}, {"keep": 0.5}])
def test_they_are_dropped_where_asked_for_or_exact_numbers_are(family_device, half_seen, plush_excerpt_cameras, prune):
    options = EncodeOptions.for_preset("fast", prune=FEW | prune)
    encoded = encode(half_seen, plush_excerpt_cameras, options, device=family_device)
    assert encoded.order.max() < 1500
    assert (encoded.unseen.splats, encoded.unseen.kept) == (300, False)


def test_another_choice_is_refused():
    with pytest.raises(UsageError, match="--unseen is 'perhaps'"):
        EncodeOptions.for_preset(prune={"unseen": "perhaps"})


def test_colours_of_seen_splats_are_treated_as_without_the_others(
    family_device, half_seen, plush_excerpt, plush_excerpt_cameras
):
    """The compaction works while splats are being removed: what it did to colours must not be lost."""
    options = EncodeOptions.for_preset("paper", prune=FEW)
    alone = encode(plush_excerpt, plush_excerpt_cameras, options, device=family_device)
    both = encode(half_seen, plush_excerpt_cameras, options, device=family_device)
    colours = []
    for encoded in (alone, both):
        seen = np.flatnonzero(encoded.order < len(plush_excerpt))
        sh = decode(b"".join(encoded.pieces)).sh[seen]
        colours.append(sh[np.argsort(encoded.order[seen])])
    np.testing.assert_array_equal(*colours)


def test_a_splat_that_only_an_added_view_sees_is_kept(family_device, half_seen, plush_excerpt_cameras):
    """Had somebody given that view, some of them would have gone."""
    given = train_views(plush_excerpt_cameras)
    # The same view, from where it sees the splats that no given one sees.
    there = dataclasses.replace(given[0], translation=given[0].translation - given[0].rotation @ np.full(3, 30.0))
    bench = Workbench(HyperParameters.from_quality(0.2), device=family_device)
    for added in (1, 0):
        state = dataclasses.replace(State.of(half_seen, [*given, there]), added=added)
        left = Prune(iterations=3).run(state, bench)
        assert (left.results.unseen.splats == 300) == bool(added)
        assert (set(range(1500, 1800)) <= set(left.survivors)) == bool(added)


# ---------------------------------- work of other stages while splats are being removed


@dataclasses.dataclass(frozen=True)
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
