"""Parts of a file, without touching the bytes of the others."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl import cli, load_scene
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.native.library import VARIABLE
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER, Coder, Property
from potr_cl.errors import DataError


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


def test_the_command(coded, tmp_path, capsys):
    (tmp_path / "a.potr").write_bytes(coded)
    command = ["decode", str(tmp_path / "a.potr"), "-o", str(tmp_path / "a.ply"), "--sh-degree"]
    assert cli.main([*command, "1"]) == 0
    assert np.array_equal(load_scene(tmp_path / "a.ply").sh, decode(coded).sh[:, :4])
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "4"])
    assert ended.value.code == 2
    assert "--sh-degree" in capsys.readouterr().err
