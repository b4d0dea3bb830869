"""Parts of a file, without touching the bytes of the others."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl import cli, load_scene
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile, decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.native.library import VARIABLE
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder, Property
from potr_cl.errors import DataError, UsageError

COEFFICIENTS = (1, 4, 9, 16)
OTHERS = ("means", "log_scales", "quaternions", "opacity_logits")


@pytest.fixture(scope="module", params=[("best", "context"), ("fast", "zstd"), ("paper", "npz")], ids=lambda p: p[0])
def coded(request, plush_excerpt):
    preset, entropy = request.param
    parameters = HyperParameters.from_quality(0.5, preset)
    return b"".join(code_scene(plush_excerpt, parameters, entropy=EntropyCoder(entropy, 3)).pieces)


def spoiled(data: bytes, spare) -> bytes:
    """The file with all sections damaged but those that ``spare`` says."""
    changed = bytearray(data)
    for section in PotrFile.from_bytes(data).header.sections:
        if section.kind != Property.METADATA and not spare(section):
            changed[section.offset] ^= 0xFF
    return bytes(changed)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("path", ["0", ""], ids=["numpy", "default"])
def test_a_lower_degree(coded, degree, path, monkeypatch):
    """The same values, though the sections of higher degrees are damaged."""
    monkeypatch.setenv(VARIABLE, path)
    whole = decode(coded)
    kept = COEFFICIENTS[degree]

    def needed(section):
        return section.kind != Property.SH or section.index < 3 * kept

    damaged = spoiled(coded, needed)
    part = decode(damaged, sh_degree=degree)
    assert part.sh.shape == (len(whole), kept, 3)
    assert np.array_equal(part.sh, whole.sh[:, :kept])
    for name in OTHERS:
        assert np.array_equal(getattr(part, name), getattr(whole, name))
    if degree < 3:
        with pytest.raises(DataError, match="checksum"):
            decode(damaged)


def test_positions_and_dc_alone(coded):
    """A point cloud: nothing else of the file need be whole, but what steps of colours are made of."""
    whole = decode(coded)
    octree = (Property.OCCUPANCY, Property.SEVERAL, Property.MULTIPLICITY, Property.TAIL_LENGTH, Property.TAIL)
    bundled = any(section.coder == Coder.BUNDLES for section in PotrFile.from_bytes(coded).header.sections)
    needed = (*octree, Property.OPACITY, Property.SCALE) if bundled else octree
    file = PotrFile.from_bytes(
        spoiled(coded, lambda section: section.kind in needed or (section.kind == Property.SH and section.index < 3))
    )
    assert np.array_equal(file.means(), whole.means)
    assert np.array_equal(file.sh(0), whole.sh[:, :1])


def test_a_degree_that_the_file_does_not_have(plush_excerpt):
    scene = plush_excerpt.subset(np.arange(50))
    scene = type(scene)(scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh[:, :4])
    data = b"".join(code_scene(scene, HyperParameters.from_quality(0.5, "best")).pieces)
    assert decode(data, sh_degree=3).sh.shape == (50, 4, 3)
    for degree in (-1, 4):
        with pytest.raises(UsageError, match=f"SH degree {degree} is unknown"):
            decode(data, sh_degree=degree)


def test_the_command(coded, tmp_path, capsys):
    (tmp_path / "a.potr").write_bytes(coded)
    command = ["decode", str(tmp_path / "a.potr"), "-o", str(tmp_path / "a.ply"), "--sh-degree"]
    assert cli.main([*command, "1"]) == 0
    assert np.array_equal(load_scene(tmp_path / "a.ply").sh, decode(coded).sh[:, :4])
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "4"])
    assert ended.value.code == 2
    assert "--sh-degree" in capsys.readouterr().err
