"""Files of blocks: what is in them, what is read of them, and files of them that lie."""

from __future__ import annotations

import dataclasses
import json
import os
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import potr_cl
from potr_cl import cli
from potr_cl.codec import blocks as blocks_geometry
from potr_cl.codec.blocks import GeometryOfBlocks, blocks_of, quantise
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import Coded, Level, code_levels, code_scene
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.scenes import ply
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import thread_pool
from potr_cl.model.box import Box
from potr_cl.model.order import morton_order
from potr_cl.model.scene import Scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tests.cases.options import as_it_is
from tests.oracles.decoder import decode as decode_independently
from tests.reference.file_parts import File
from tests.reference.scenes import random_scene, ring_of_cameras

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
BEST = HyperParameters.from_quality(0.5, "best")


def in_blocks(scene: Scene, most: int, effects=None, threads: int = 0, **options) -> Coded:
    geometry = quantise(scene, BEST, ring_of_cameras(4), rows=blocks_of(scene.means, most))
    assert isinstance(geometry, GeometryOfBlocks)
    if effects is not None:
        geometry = geometry.with_steps(effects)
    return code_levels([Level(scene, geometry)], b'{"q":0.5}', threads=threads, **options)


def effects_of(scene: Scene) -> np.ndarray:
    return np.exp(np.random.default_rng(3).normal(size=len(scene)))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(1600, 2, seed=4)


@pytest.fixture(scope="module")
def data(scene) -> bytes:
    return b"".join(in_blocks(scene, 400, effects_of(scene)).pieces)


def same(one: Scene, other: Scene) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


# What is in them -----------------------------------------------------------------------------------------------------


def test_values_are_those_of_one_piece(scene):
    """But for centres, each block's octree being its own, within the tolerance of both."""
    apart, whole = in_blocks(scene, 400), code_scene(scene, BEST, ring_of_cameras(4))
    a, b = decode(b"".join(apart.pieces)), decode(b"".join(whole.pieces))
    back_a, back_b = np.argsort(apart.order), np.argsort(whole.order)
    assert sorted(apart.order) == list(range(len(scene)))
    for name in ARRAYS[1:]:
        assert np.array_equal(getattr(a, name)[back_a], getattr(b, name)[back_b]), name
    error_a = np.linalg.norm(a.means[back_a] - scene.means, axis=1)
    error_b = np.linalg.norm(b.means[back_b] - scene.means, axis=1)
    assert np.sqrt((error_a**2).mean()) < 1.2 * np.sqrt((error_b**2).mean())


@pytest.mark.parametrize("entropy", ["bundles", "zstd"])
def test_the_number_of_threads_changes_nothing(scene, entropy):
    coded = [in_blocks(scene, 200, effects_of(scene), n, entropy=EntropyCoder(entropy, 3)).pieces for n in (1, 16)]
    assert b"".join(coded[0]) == b"".join(coded[1])
    files = [open_file(b"".join(pieces)) for pieces in coded]
    assert same(files[0].scene(threads=1), files[1].scene(threads=16))


def test_the_independent_decoder_agrees(data):
    scene, independent = decode(data), decode_independently(data)
    assert np.array_equal(scene.means, independent["means"].astype(np.float32))
    assert np.allclose(np.exp(scene.log_scales), independent["scales"], rtol=1e-5)
    assert np.allclose(scene.opacities, independent["opacities"], atol=1e-6)
    assert np.allclose(scene.sh, independent["sh"], rtol=1e-6, atol=1e-6)
    assert independent["metadata"] == open_file(data).metadata == {"q": 0.5}


def test_equal_effects_have_equal_steps_in_all_blocks():
    """Where little shows, steps are coarser, though all splats of that block show little; the error is shared out."""
    scene = random_scene(4000, 0, seed=6)
    left = scene.means[:, 0] < np.median(scene.means[:, 0])
    effects = np.where(left, 100.0, 1.0) * effects_of(scene)
    rows = (np.flatnonzero(left), np.flatnonzero(~left))
    geometry = quantise(scene, BEST, [], rows=rows)
    whole = quantise_geometry(scene, BEST, []).with_steps(effects)
    assert isinstance(geometry, GeometryOfBlocks)
    dc, _ = geometry.with_steps(effects).colour_classes()
    found, wanted = np.empty(len(scene)), np.empty(len(scene))
    found[geometry.order], wanted[whole.order] = dc, whole.colour_classes()[0]
    assert found[left].mean() - found[~left].mean() > 5
    for side in (left, ~left):
        assert abs(found[side].mean() - wanted[side].mean()) < 2


@pytest.mark.parametrize("most", [1, 300, 4000, 9999])
def test_blocks_are_ranges_of_the_morton_order(most):
    """Also where a block ends among splats whose codes begin alike, or are the same."""
    rng = np.random.default_rng(most)
    means = np.concatenate([rng.normal(size=(5000, 3)), rng.normal(size=(3000, 3)) / 1e4]).astype(np.float32)
    means = rng.permutation(np.concatenate([means, np.repeat(means[:20], 60, axis=0), [[1e30] * 3]]).astype(np.float32))
    with thread_pool(3) as pool:
        blocks = blocks_of(means, most, pool.map)
    order, start = morton_order(means), 0
    for rows in blocks:
        assert np.array_equal(rows, np.sort(order[start : start + len(rows)]))
        start += len(rows)
    assert start == len(means)
    assert max(map(len, blocks)) - min(map(len, blocks)) <= 1


def test_many_splats_are_written_in_blocks(monkeypatch, plush_excerpt, plush_excerpt_cameras):
    """By a whole encode, of so many splats that are left; few stay what they were, byte for byte."""
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 3})
    few = encode(plush_excerpt, plush_excerpt_cameras, options)
    assert len(open_file(few.data).blocks) == 1
    monkeypatch.setattr(blocks_geometry, "MOST_WHOLE", 300)
    monkeypatch.setattr(blocks_geometry, "MOST_A_BLOCK", 256)
    many = encode(plush_excerpt, plush_excerpt_cameras, options)
    file = open_file(many.data)
    assert len(file.blocks) == -(-len(many.order) // 256)
    assert file.metadata["source_splats"] == len(plush_excerpt)
    assert abs(len(many.order) - len(few.order)) <= 2
    assert many.refitted is not None
    assert many.refitted.errors[1] < 1.1 * few.refitted.errors[1]
    assert same(many.scene, decode(many.data))
    in_place = plush_excerpt.subset(many.order).means - many.scene.means
    assert np.abs(in_place).max() < 0.02


def test_blocks_of_any_size_may_be_asked_for():
    options = as_it_is("best").with_parameters(block_splats=1 << 14)
    blocks = open_file(b"".join(encode(random_scene(40_000, 0), None, options).pieces)).blocks
    assert [block.splats for block in blocks] == [13_333, 13_333, 13_334]
    with pytest.raises(UsageError, match=r"block_splats is 100, it must lie between 16384 and 4\.1943e"):
        _ = as_it_is("best").with_parameters(block_splats=100).parameters


@pytest.mark.slow
def test_they_cost_next_to_nothing():
    scene = random_scene(100_000, 1, seed=9)
    whole = code_scene(scene, BEST, ring_of_cameras(4))
    assert in_blocks(scene, 50_000).nbytes < 1.005 * whole.nbytes


# What is read of them ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(data) -> Scene:
    return decode(data)


def inside(scene: Scene, box: list[float]) -> Scene:
    low, high = np.float32(box).reshape(2, 3)
    return scene.subset(np.flatnonzero(((scene.means >= low) & (scene.means <= high)).all(axis=1)))


def spoilt_but(data: bytes, spare: list[int]) -> bytes:
    changed = bytearray(data)
    for number, block in enumerate(open_file(data).blocks):
        if number not in spare:
            changed[block.offset : block.offset + block.nbytes] = bytes(block.nbytes)
    return bytes(changed)


def test_blocks_decode_alone(data, whole, tmp_path):
    file = tmp_path / "a.potr"
    for number, block in enumerate(open_file(data).blocks):
        file.write_bytes(spoilt_but(data, [number]))
        assert same(open_file(file).part(number), whole.subset(np.arange(block.first, block.first + block.splats)))
    with pytest.raises(DataError, match=r"a.potr': block \d: section '.*' is damaged"):
        decode(file)


def test_a_box_reads_only_what_it_meets(data, whole):
    file, read = open_file(data), []
    middle = np.median(whole.means[: file.blocks[0].splats], axis=0).tolist()
    corners = [*(x - 0.5 for x in middle), *(x + 0.5 for x in middle)]
    box = Box.of(corners)
    met = file.numbers(box)
    assert 0 < len(met) < len(file.blocks)
    found = potr_cl.decode(spoilt_but(data, met), box=corners)
    counting = dataclasses.replace(file, read=lambda *part: read.append(part) or file.read(*part))
    assert same(counting.scene(box=box), found)
    assert sorted(read) == [(file.blocks[k].offset, file.blocks[k].nbytes) for k in met]
    assert 0 < len(found) < len(whole)
    assert same(found, inside(whole, corners))


@pytest.fixture(scope="module", params=["blocks", "one piece"])
def any_file(request, scene, data) -> bytes:
    return data if request.param == "blocks" else b"".join(code_scene(scene, BEST).pieces)


def test_a_box_of_any_file(any_file, tmp_path):
    (tmp_path / "a.potr").write_bytes(any_file)
    box = ["-0.5", "-inf", "-1e-3", "0.25", "inf", "2"]
    assert cli.main(["decode", str(tmp_path / "a.potr"), "-o", str(tmp_path / "a.ply"), "--box", *box]) == 0
    assert same(ply.load(tmp_path / "a.ply"), inside(decode(any_file), [float(number) for number in box]))


@pytest.mark.parametrize("box", [[90] * 3 + [91] * 3, [1, 0, 0, 0, 1, 1], [0, 0, 0, 1, 1], [0, 0, 0, 1, 1, np.nan]])
def test_boxes_that_are_refused(box, any_file):
    with pytest.raises(UsageError, match="NaN" if box[-1] != box[-1] else r"^(?!.*NaN).*box"):
        potr_cl.decode(any_file, box=box)


def test_a_lower_degree(data, whole):
    for degree, coefficients in enumerate((1, 4, 9, 9)):
        part = decode(data, sh_degree=degree)
        assert np.array_equal(part.sh, whole.sh[:, :coefficients])
        assert np.array_equal(part.means, whole.means)
    for degree in (-1, 4):
        with pytest.raises(UsageError, match=f"SH degree {degree} is unknown"):
            decode(data, sh_degree=degree)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_from_a_pipe(data, whole, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with ThreadPoolExecutor(1) as pool:
        pool.submit((tmp_path / "pipe").write_bytes, data)
        assert same(decode(tmp_path / "pipe"), whole)


def test_info_lists_the_blocks(data, tmp_path, capsys):
    (tmp_path / "a.potr").write_bytes(data)
    found = potr_cl.info(tmp_path / "a.potr")
    assert [block["splats"] for block in found["blocks"]] == [400] * 4
    assert found["splats"] == 1600
    assert sum(entry["bytes"] for entry in found["sections"].values()) == len(data)
    json.dumps(found.facts)
    assert cli.main(["info", str(tmp_path / "a.potr")]) == 0
    assert "blocks          4, of 400 to 400 splats" in capsys.readouterr().out


def test_a_file_that_gets_shorter_while_it_is_open(data, tmp_path):
    path = tmp_path / "a.potr"
    path.write_bytes(data)
    file = open_file(path)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="was changed while it was read"):
        file.scene()
    path.unlink()
    with pytest.raises(UsageError, match="cannot read"):
        file.scene()


@pytest.mark.parametrize(("most", "of_all", "looked_at"), [(3_000, 1, "peak"), (12_000, 0.9, "left")])
def test_where_memory_is_bounded_colours_are_decoded_to_the_disk(most, of_all, looked_at):
    """Those of all blocks together, and those of the blocks that threads decode meanwhile; those of one block."""
    scene = random_scene(12_000, 3, seed=1)
    data = b"".join(in_blocks(scene, most, entropy=EntropyCoder("zstd", 1)).pieces)

    def decoded(memory: float | None) -> tuple[Scene, int]:
        tracemalloc.start()
        with bounded(memory):
            found = decode(data)
        left, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return found, left if looked_at == "left" else peak

    decode(data)  # what is kept of it for the next one is no matter here
    (expected, whole), (found, little) = decoded(None), decoded(64 * 60_000)  # larger arrays are large
    assert same(found, expected)
    assert little < whole - of_all * scene.sh.nbytes


# Files that lie ------------------------------------------------------------------------------------------------------


def test_a_box_that_its_centres_are_not_in(data):
    file = File.of(data)
    file.blocks[1].reals[:6] = [8.0, 8.0, 8.0, 9.0, 9.0, 9.0]
    with pytest.raises(DataError, match="block 1: centres lie outside of the block's box"):
        decode(file.bytes())
    with pytest.raises(ValueError, match="outside"):
        decode_independently(file.bytes())


@pytest.mark.slow
def test_single_bytes_changed(data):
    """Every byte is covered by a checksum: none can be changed unseen."""
    rng = np.random.default_rng(1)
    for at in [*range(32), *rng.integers(32, len(data), 80)]:
        changed = bytearray(data)
        changed[at] ^= 1 << rng.integers(8)
        with pytest.raises(DataError):
            decode(bytes(changed))
