"""The function encode reports what the command prints."""

from __future__ import annotations

import inspect
import json

import pytest

import potr_cl
from potr_cl import cli
from potr_cl.api.choices import EncodeChoices
from potr_cl.pipeline.options import stage_keywords

pytestmark = pytest.mark.one_runtime
#: What differs from call to call.
OWN = {"file", "command", "seconds", "source"}


def test_the_report_is_what_the_command_prints(files, tmp_path, capsys, caplog):
    scene, cameras = files["scene"], files["cameras"]
    words = ["encode", scene, "--cameras", cameras, "--iterations", "2", "--refit", "1", "-o"]
    assert cli.main([str(word) for word in [*words, tmp_path / "a.potr", "--json"]]) == 0
    typed = json.loads(capsys.readouterr().out)
    assert cli.main([str(word) for word in [*words, tmp_path / "b.potr"]]) == 0
    summary = capsys.readouterr().out
    caplog.set_level("INFO", "potr_cl")
    encoded = potr_cl.encode(scene, cameras, iterations=2, refit=1, judge=True)
    assert encoded.data == (tmp_path / "a.potr").read_bytes()
    report = json.loads(json.dumps(encoded.report))
    assert {name: report[name] for name in report.keys() - OWN} == {name: typed[name] for name in typed.keys() - OWN}
    same = [line for line in summary.splitlines() if not line.startswith(("time", str(tmp_path)))]
    assert set(same) <= set(str(encoded.report).splitlines())
    assert any("kernels for" in message for message in caplog.messages)


def test_without_cameras_virtual_ones_are_placed_and_nothing_is_judged_unless_asked_for(plush_excerpt):
    encoded = potr_cl.encode(plush_excerpt, virtual_views=8, iterations=1, refit=False)
    assert encoded.report["quality"] == "not judged, as asked"
    assert encoded.report["bytes"] == encoded.nbytes
    assert potr_cl.info(encoded)["cameras"] == "virtual"


def test_help_fits_a_screen_and_leads_to_all_options():
    said = inspect.getdoc(potr_cl.encode)
    assert len(said.splitlines()) + 2 <= 50
    assert "EncodeChoices" in said
    listed = inspect.getdoc(EncodeChoices)
    for name in EncodeChoices.__annotations__.keys() - {"between", "code", "merge"}:
        assert f"{name}:" in listed or f"{name}," in listed, name
    assert stage_keywords().keys() <= EncodeChoices.__annotations__.keys()
