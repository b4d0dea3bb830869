"""The keywords that editors and type checkers know are those that there are."""

from __future__ import annotations

import pytest

from potr_cl.api.choices import CompactChoices, PruneChoices, StageChoices
from potr_cl.pipeline.options import stage_keywords
from potr_cl.pipeline.presets import DEFAULT, stages_of
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune


@pytest.mark.parametrize(
    ("choices", "stages"),
    [(StageChoices, stages_of(DEFAULT)), (PruneChoices, [Prune]), (CompactChoices, [Compact])],
)
def test_every_option_of_a_stage_is_a_keyword_with_a_type(choices, stages):
    known = stage_keywords(stages)
    names = set(choices.__annotations__)
    assert names == set(known) | {kind.name for kind in stages}
    for name, (kind, _, flag) in known.items():
        hint = str(choices.__annotations__[name])
        assert "None" in hint, name
        if flag.kind in (int, float):
            assert flag.kind.__name__ in hint, name
        assert all(choice in hint for choice in flag.choices) or name == "entropy", name
        assert ("bool" in hint) == (name == kind.name or (not flag.metavar and not flag.choices)), name
