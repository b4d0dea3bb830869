"""Versions of the format: what each can hold, and that a new one is one object."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec import versions
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile, decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder
from potr_cl.codec.versions import VERSIONS
from potr_cl.errors import DataError, UsageError
from tests.reference.scenes import random_scene


def file_of(scene, parameters, **options) -> bytes:
    return b"".join(code_scene(scene, parameters, **options).pieces)


def test_versions_are_known_by_their_numbers():
    assert {number: version.number for number, version in VERSIONS.items()} == {1: 1, 2: 2, 3: 3}


@pytest.mark.parametrize("preset", ["paper", "best"])
@pytest.mark.parametrize("entropy", ["context", "zstd", "npz"])
def test_files_hold_the_coders_that_their_version_has(preset, entropy):
    parameters = HyperParameters.from_quality(0.5, preset)
    file = PotrFile.from_bytes(file_of(random_scene(2000, 1), parameters, entropy=EntropyCoder(entropy)))
    coders = {section.coder for section in file.header.sections}
    assert coders <= VERSIONS[file.header.version].coders
    assert (Coder.BUNDLES in coders) == (preset == "best" and entropy == "context")


def test_factors_of_colours_that_version_1_cannot_tell_are_refused():
    """Its header has one factor: AC coefficients would come back multiplied by the ratio of the two."""
    unlike = HyperParameters.from_quality(0.5, sf_dc=30)
    with pytest.raises(UsageError, match="DC and AC are 30 and 51"):
        code_scene(random_scene(20, 1), unlike)
    for alike in (HyperParameters.from_quality(0.5, sf_sh=30), HyperParameters.from_quality(0.5, sf_sh=9, sf_dc=9)):
        scene = random_scene(300, 1)
        coded = code_scene(scene, alike)
        error = np.abs(decode(b"".join(coded.pieces)).sh - scene.sh[coded.order]).max()
        assert error <= 1.5 / alike.sf_sh + 1e-6  # each of three channels is off by half a step
    best = HyperParameters.from_quality(0.5, "best", sf_dc=30)
    assert PotrFile.from_bytes(file_of(random_scene(20, 1), best)).header.sf_dc == 30


@pytest.mark.parametrize("entropy", ["context", "zstd"])
def test_version_2_is_still_written_where_it_is_asked_for(entropy):
    parameters = dataclasses.replace(HyperParameters.from_quality(0.5, "best"), version=2)
    scene = random_scene(600, 2, seed=5)
    data = file_of(scene, parameters, entropy=EntropyCoder(entropy))
    assert PotrFile.from_bytes(data).header.version == 2
    # Without anything known of what its splats show, a file of version 3 has the same values.
    newest = decode(file_of(scene, dataclasses.replace(parameters, version=3), entropy=EntropyCoder(entropy)))
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        assert np.array_equal(getattr(decode(data), name), getattr(newest, name))


class Version5(versions.Version2):
    """Opacities as they are, rotations of one factor, a single factor for all of SH: nothing else is told of it."""

    number = 5
    coders = frozenset({Coder.RAW, Coder.CONTEXT, Coder.ZSTD})
    separate_ac_factor = False
    rotations_need_scales = False
    quantize_rotations = versions.Version1.quantize_rotations
    rotation_factors = versions.Version1.rotation_factors

    def quantize_opacities(self, logits, sf_opacity):
        return np.rint(sf_opacity / (1 + np.exp(-logits))).astype(np.int16)

    def dequantize_opacities(self, levels, sf_opacity):
        opacities = np.clip(levels / np.float32(sf_opacity), 0.001, 0.999).astype(np.float32)
        return np.log(opacities / (1 - opacities), dtype=np.float32)


@pytest.mark.parametrize("entropy", ["context", "zstd"])
def test_a_new_version_is_one_object(monkeypatch, entropy):
    scene = random_scene(2000, 2)
    parameters = dataclasses.replace(
        HyperParameters.from_quality(0.7, "best", sf_dc=60, sf_sh=60, sf_opacity=200, sf_rotation=100), version=5
    )
    monkeypatch.setitem(VERSIONS, 5, Version5())
    coded = code_scene(scene, parameters, entropy=EntropyCoder(entropy))
    data = b"".join(coded.pieces)
    file, source = PotrFile.from_bytes(data), scene.subset(coded.order)
    assert file.header.version == 5
    assert (file.header.sf_dc, file.header.sf_ac) == (60, 60)
    assert (Coder.CONTEXT in {section.coder for section in file.header.sections}) == (entropy == "context")
    back = file.scene()
    assert np.abs(back.opacities - source.opacities).max() <= 0.5 / 200 + 1e-3
    assert np.abs(back.sh - source.sh).max() <= 1.5 / 60 + 1e-5
    assert np.array_equal(file.quaternions(), back.quaternions)
    assert np.allclose(np.linalg.norm(back.quaternions, axis=1), 1, atol=1e-6)
    monkeypatch.undo()
    with pytest.raises(DataError, match="format version 5, this potr_cl reads up to 4"):
        decode(data)


def test_a_coder_that_the_version_has_not_is_refused(monkeypatch):
    class WithoutDeflate(versions.Version1):
        coders = frozenset({Coder.RAW, Coder.ZSTD})

    data = file_of(random_scene(500, 1), HyperParameters.from_quality(0.5), entropy=EntropyCoder("npz"))
    assert len(decode(data)) == 500
    monkeypatch.setitem(VERSIONS, 1, WithoutDeflate())
    with pytest.raises(DataError, match="is of coder 2, which format version 1 does not have"):
        decode(data)
