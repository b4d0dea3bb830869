"""Options nested by stage, and the table of presets."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.codec import quantize
from potr_cl.errors import UsageError
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import DEFAULT, PRESETS, stages_of
from potr_cl.stages.code import Code
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option
from tests.reference.scenes import random_scene


def test_no_options_are_the_default_preset():
    assert EncodeOptions() == EncodeOptions.for_preset() == EncodeOptions.for_preset(DEFAULT)
    assert EncodeOptions().stages == PRESETS[DEFAULT]
    assert EncodeOptions(preset="fast").prune.iterations == 16


@pytest.mark.parametrize("preset", quantize.PRESETS)
def test_every_preset_ends_in_code_and_names_each_stage_once(preset):
    names = [stage.name for stage in PRESETS[preset]]
    assert names[-1] == "code"
    assert len(set(names)) == len(names)
    assert set(stages_of(preset)) <= set(stages_of(DEFAULT))  # whose flags the command line has


def test_changes_reach_the_stage_that_they_name():
    options = EncodeOptions.for_preset("best", q=0.3, prune={"iterations": 7}, refit=False, compact=True)
    assert (options.q, options.prune.iterations, options.stage(Refit).on, options.compact.on) == (0.3, 7, False, True)
    assert options.changed(prune={"turns": 2}).stage(Prune) == Prune(iterations=7, turns=2)
    assert EncodeOptions() == EncodeOptions()  # nothing was changed in place


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"itertions": 3}, "unknown option 'itertions'"),
        ({"prune": {"itertions": 3}}, "stage 'prune' has no option 'itertions'"),
        ({"prune": {"keep": 2.0}}, "must be above 0 and at most 1"),
        ({"code": False}, "stage 'code' makes the file"),
        ({"prune": 3}, "'prune' is 3: give a mapping of its options, True or False"),
        ({"code": {"entropy": "gzip"}}, "'gzip' is unknown"),
    ],
)
def test_what_there_is_not_is_named(changes, says):
    with pytest.raises(UsageError, match=says):
        EncodeOptions.for_preset("best", **changes)
    with pytest.raises(UsageError, match="preset 'worst' is unknown: choose one of best, smallest, fast, paper"):
        EncodeOptions.for_preset("worst")


def test_a_stage_that_only_other_presets_have(monkeypatch):
    monkeypatch.setitem(PRESETS, "fast", tuple(s for s in PRESETS["fast"] if s.name != "prune"))
    with pytest.raises(UsageError, match="preset 'fast' has no stage 'prune': it is in best, smallest, paper"):
        EncodeOptions.for_preset("fast", prune={"iterations": 7})


@pytest.mark.parametrize("refit", [False, {"on": False}, {"steps": 0}])
def test_without_a_refit_colours_are_compacted_unless_told_otherwise(refit):
    assert EncodeOptions.for_preset("best", refit=refit).compact.on
    assert not EncodeOptions.for_preset("best", refit=refit, compact=False).compact.on
    assert EncodeOptions.for_preset("best", refit=refit, compact={"at": 0.5}).compact.on


def test_steps_of_a_refit_are_a_number_or_auto():
    with pytest.raises(UsageError, match="the re-fit's steps are 'many': give a number, or auto"):
        EncodeOptions.for_preset("best", refit={"steps": "many"})
    assert EncodeOptions.for_preset("fast", refit={"steps": "auto"}).refit.steps_on("cpu") == 6


def test_a_refit_that_the_preset_does_not_have_stands_in_for_the_compaction():
    assert EncodeOptions.for_preset("paper").compact.on
    assert not EncodeOptions.for_preset("paper", refit={"steps": 8}).compact.on
    assert EncodeOptions.for_preset("paper", refit={"steps": 8}, compact=True).compact.on
    assert EncodeOptions.for_preset("paper", refit={"drop": 1e-6}).compact.on  # of no steps


def test_stages_replace_the_parameters_that_q_sets():
    options = EncodeOptions(q=0.7).with_parameters(delta_mse_max=1e-7, sf_dc=9.0)
    assert (options.prune.delta_mse_max, options.code.sf_dc) == (1e-7, 9.0)
    assert (options.parameters.delta_mse_max, options.parameters.sf_dc) == (1e-7, 9.0)
    assert options.parameters.sf_sh == EncodeOptions(q=0.7).parameters.sf_sh
    with pytest.raises(UsageError, match="no stage replaces the hyper-parameter 'sf_hue'"):
        options.with_parameters(sf_hue=1.0)


def test_options_are_ready_for_json():
    options = EncodeOptions.for_preset("fast", refit={"ground_truth": Path("photos")})
    back = json.loads(json.dumps(options.as_dict()))
    assert back["refit"]["ground_truth"] == "photos"
    assert back["prune"]["iterations"] == 16


@dataclass(frozen=True)
class Brighten(Stage):
    """A stage as somebody might add it: its options, and one method."""

    name = "brighten"
    title = "brightness"
    needs_views = False

    by: float = option(0.25, Flag("--brighten", "added to every colour", "X", float))
    twice: bool = option(False, Flag("--twice", "do it twice"))

    def run(self, state: State, bench: Workbench) -> State:
        sh = state.scene.sh.copy()
        sh[:, 0] += np.float32(self.by * (1 + self.twice))
        return state.recoloured(sh)


def test_a_new_stage_is_run_and_has_flags():
    """One class and one place in a tuple of stages is all that it takes."""
    parser = argparse.ArgumentParser()
    add_stage_flags(parser, [Brighten])
    assert "added to every colour; default: 0.25" in parser.format_help().replace("\n", " ")
    chosen = stage_choices(parser.parse_args(["--brighten", "0.5", "--twice"]), [Brighten])
    assert chosen == {"brighten": {"by": 0.5, "twice": True}}
    options = EncodeOptions(stages=(Brighten(), Code())).changed(**chosen)
    scene = random_scene(50, 0)
    plain = encode(scene, None, EncodeOptions(stages=(Code(),)))
    brighter = encode(scene, None, options)
    assert brighter.pieces != plain.pieces
    assert options.as_dict()["brighten"] == {"on": True, "by": 0.5, "twice": True}
