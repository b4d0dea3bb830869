"""Parts of a .potr file: levels of detail, joined without coding anything anew; lower degrees, single properties."""

from __future__ import annotations

import json

import numpy as np
import pytest

import potr_cl
from potr_cl import DataError, UsageError, cli
from potr_cl.codec.blocks import blocks_of, quantise
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.levels import joined_levels, level_within, splats_of_levels
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER, Coder, Property
from potr_cl.native.library import VARIABLE
from tests.reference.scenes import random_scene

SIZES = (400, 150, 60)
ERRORS = (0.0, 0.25, 0.5)


@pytest.fixture(scope="module")
def files() -> list[bytes]:
    """One scene in three sizes; the finest in several blocks."""
    scene, parameters = random_scene(SIZES[0], 2), HyperParameters.from_quality(0.5, "best")
    blocks = quantise(scene, parameters, (), rows=blocks_of(scene.means, 200))
    found = [code_scene(scene, parameters, metadata=b'{"q":0.5}', geometry=blocks)]
    found += [code_scene(scene.subset(np.arange(size)), parameters) for size in SIZES[1:]]
    return [b"".join(coded.pieces) for coded in found]


@pytest.fixture(scope="module")
def joined(files) -> bytes:
    return b"".join(joined_levels([open_file(data) for data in files], ERRORS))


def test_every_level_is_what_its_own_file_holds(files, joined):
    opened = open_file(joined)
    assert opened.metadata == {"q": 0.5}
    assert splats_of_levels(opened) == list(SIZES)
    assert [block.level for block in opened.blocks] == [2, 1, 0, 0]
    assert [block.error for block in opened.blocks] == [0.5, 0.25, 0, 0]
    for level, data in enumerate(files):
        of_level, alone = decode(joined, level=level), decode(data)
        for field in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
            assert np.array_equal(getattr(of_level, field), getattr(alone, field)), field
    # Who asks for a scene gets the finest.
    assert len(decode(joined)) == len(potr_cl.decode(joined)) == SIZES[0]


def test_a_block_may_stand_for_those_below_it(joined):
    coarsest, coarse, *finest = open_file(joined).blocks
    for block, below in [(coarsest, [coarse]), (coarse, finest)]:
        for each in below:
            assert np.array_equal(np.minimum(block.box.low, each.box.low), block.box.low)
            assert np.array_equal(np.maximum(block.box.high, each.box.high), block.box.high)


def test_the_finest_level_within_a_budget(joined):
    opened = open_file(joined)
    assert [level_within(opened, budget) for budget in (1000, 400, 399, 150, 60)] == [0, 0, 1, 1, 2]
    with pytest.raises(UsageError, match="no level has 59 splats or fewer: the coarsest has 60"):
        level_within(opened, 59)
    with pytest.raises(UsageError, match="not both"):
        potr_cl.decode(joined, level=1, splats=100)


def test_a_damaged_level_is_not_joined(files):
    spoiled = bytearray(files[1])
    spoiled[-1] ^= 0xFF
    with pytest.raises(DataError, match="checksum"):
        joined_levels([open_file(files[0]), open_file(bytes(spoiled))], [0, 1])


@pytest.mark.parametrize(
    ("choice", "name", "result"),
    [
        ([], "a.ply", 400),
        (["--level", "1"], "a.spz", 150),
        (["--splats", "399"], "a.ply", 150),
        (["--level", "3"], "a.ply", "there is no level 3: the file has levels 0 to 2"),
        (["--splats", "59"], "a.ply", "no level has 59 splats or fewer"),
    ],
)
def test_the_command_decodes_a_level_or_says_that_it_is_not_there(joined, tmp_path, capsys, choice, name, result):
    file, output = tmp_path / "a.potr", tmp_path / name
    file.write_bytes(joined)
    code = cli.main(["decode", str(file), "-o", str(output), *choice])
    if code == 0:
        assert len(potr_cl.load_scene(output)) == result
    else:
        assert code == 2
        assert result in capsys.readouterr().err
        assert not output.exists()


def test_info_shows_the_levels(joined, tmp_path, capsys):
    file = tmp_path / "a.potr"
    file.write_bytes(joined)
    assert cli.main(["info", str(file)]) == 0
    assert "0: 400 splats\n                1: 150 splats, error 0.25\n" in capsys.readouterr().out
    assert cli.main(["info", str(file), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["levels"], facts["level_splats"], facts["level_errors"]) == (3, list(SIZES), list(ERRORS))


# Degrees and properties -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[("best", "bundles"), ("fast", "zstd"), ("paper", "zstd")], ids=lambda p: p[0])
def coded(request, plush_excerpt):
    preset, entropy = request.param
    parameters = HyperParameters.from_quality(0.5, preset)
    return b"".join(
        code_scene(plush_excerpt.subset(np.arange(400)), parameters, entropy=EntropyCoder(entropy, 3)).pieces
    )


def spoiled(data: bytes, spare) -> bytes:
    """The file with all sections damaged but those that ``spare`` says."""
    changed, block = bytearray(data), open_file(data).blocks[0]
    for section in block.sections:
        if not spare(section.kind):
            changed[block.offset + section.offset] ^= 0xFF
    return bytes(changed)


@pytest.mark.parametrize("path", ["0", ""], ids=["numpy", "default"])
def test_a_lower_degree(coded, path, monkeypatch):
    """The same values, though the sections of higher degrees are damaged."""
    whole = decode(coded)
    monkeypatch.setenv(VARIABLE, path)
    for degree, coefficients in enumerate((1, 4, 9, 16)):
        damaged = spoiled(coded, lambda kind, most=degree: (kind.degree or 0) <= most)
        part = decode(damaged, sh_degree=degree)
        assert np.array_equal(part.sh, whole.sh[:, :coefficients])
        for name in ("means", "log_scales", "quaternions", "opacity_logits"):
            assert np.array_equal(getattr(part, name), getattr(whole, name))
        if degree < 3:
            with pytest.raises(DataError, match="checksum"):
                decode(damaged)


def test_positions_and_dc_alone(coded):
    """A point cloud: nothing else of the file need be whole, but what contexts and steps of colours are made of."""
    whole = decode(coded)
    octree = ORDER[: ORDER.index(Property.STEPS)]
    bundled = open_file(coded).blocks[0].coder == Coder.BUNDLES
    needed = (*octree, Property.SH0, Property.OPACITY, *([Property.SCALE] if bundled else []))
    body = open_file(spoiled(coded, lambda kind: kind in needed)).body(0)
    assert np.array_equal(body.means(), whole.means)
    assert np.array_equal(body.sh(0), whole.sh[:, :1])


def test_the_command_decodes_a_degree(coded, tmp_path, capsys):
    (tmp_path / "a.potr").write_bytes(coded)
    command = ["decode", str(tmp_path / "a.potr"), "-o", str(tmp_path / "a.ply"), "--sh-degree"]
    assert cli.main([*command, "1"]) == 0
    assert np.array_equal(potr_cl.load_scene(tmp_path / "a.ply").sh, decode(coded).sh[:, :4])
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "4"])
    assert ended.value.code == 2
    assert "--sh-degree" in capsys.readouterr().err
