"""The native path: the same bits as NumPy's, the same refusals, and never beyond its buffers."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from potr_cl.codec import block_values
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Property
from potr_cl.errors import DataError, UsageError
from potr_cl.model.scene import Scene
from potr_cl.native import library
from potr_cl.native.library import LIBRARY_VARIABLE, VARIABLE, native
from tests.reference.file_parts import STREAMS, File, sealed
from tests.reference.scenes import random_scene

GOLDEN = sorted((Path(__file__).parents[1] / "data").glob("golden_*.potr"))
PATHS = {"numpy": "0", "native": "1"}
#: A path is chosen by the environment: hypothesis need not undo it between its examples, as each sets it anew.
SETTINGS = settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@pytest.fixture
def choose(monkeypatch):
    """Chooses a path by name; skips where there is no compiled library."""
    monkeypatch.delenv(VARIABLE, raising=False)
    if native() is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")
    return lambda path: monkeypatch.setenv(VARIABLE, PATHS[path])


def outcome(data: bytes, threads: int = 1, trust: bool = False) -> bytes | str:
    """All bits of a scene, or the words of a refusal."""
    try:
        scene = open_file(data, trust).scene(threads)
    except DataError as error:
        return str(error)
    arrays = (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh)
    return b"".join(array.tobytes() for array in arrays)


def read_alike(data: bytes, choose, threads: int = 1, trust: bool = False) -> bool:
    """Whether both paths read a file, to the same bits; or else they refuse it for the same reason."""
    found = []
    for path in PATHS:
        choose(path)
        found.append(outcome(data, threads, trust))
    assert found[0] == found[1]
    return isinstance(found[0], bytes)


def coded(scene: Scene, preset="best", q=0.5, entropy="bundles") -> bytes:
    parameters = HyperParameters.from_quality(q, preset)
    return b"".join(code_scene(scene, parameters, entropy=EntropyCoder(entropy, 1)).pieces)


# The same bits --------------------------------------------------------------------------------------------------------


@given(
    splats=st.sampled_from([1, 2, 3, 7, 127, 128, 129, 255, 256, 257, 511, 513, 1500]),
    degree=st.integers(0, 3),
    seed=st.integers(0, 2**16),
    preset=st.sampled_from(["paper", "fast", "best"]),
    entropy=st.sampled_from(["bundles", "zstd"]),
    q=st.floats(0, 1),
    spread=st.sampled_from([1e-3, 1.0, 30.0]),
    copies=st.integers(1, 4),
)
@SETTINGS
def test_any_scene(splats, degree, seed, preset, entropy, q, spread, copies, choose):
    """Small and large integers of every property, whole lanes and odd ones, splats in one place."""
    scene = random_scene(splats, degree, seed=seed)
    scene = scene.subset(np.repeat(np.arange(splats), np.arange(splats) % copies + 1))
    scene.log_scales[...] += np.float32(np.log(spread))
    scene.sh[...] *= np.float32(spread)
    assert read_alike(coded(scene, preset, q, entropy), choose, 2)


@pytest.mark.slow
def test_more_lanes_than_a_group_and_lanes_of_many_steps(choose):
    """Steps in which only some lanes have a splat; groups of lanes that are cut short."""
    for splats in (256 * 130 + 1, 8192 * 257 + 3):
        scene = random_scene(400, 0, seed=splats).subset(np.arange(splats) % 400)
        assert read_alike(coded(scene), choose, 2, trust=True)


@pytest.mark.parametrize(("splats", "q"), [(1, 0.5), (257, 1.0), (1000, 0.0)])
def test_the_encoder_writes_the_same_bytes(splats, q, choose):
    scene, files = random_scene(splats, 2, seed=splats), set()
    scene.sh[...] *= np.float32(10)
    for path in PATHS:
        choose(path)
        files.add(coded(scene, q=q))
    assert len(files) == 1


# The same refusals ----------------------------------------------------------------------------------------------------


def at(data: bytes, prop: Property) -> tuple[int, int]:
    """Where a section of a file's only block begins, and its size."""
    block = open_file(data).blocks[0]
    section = block.find(prop)
    return block.offset + section.offset, section.stored_bytes


@pytest.fixture(scope="module")
def of_many_bundles() -> bytes:
    return coded(random_scene(5 * 8192, 1, seed=4))


def said_of(data: bytes) -> str:
    """The only refusal, however many threads decode."""
    (said,) = {outcome(data, threads) for threads in (1, 1, 2, 3, 4, 4, 4)}
    return said


@pytest.mark.parametrize(
    "what", ["checksum of one", "contexts of one, checksum of the next", "words, checksum of another"]
)
def test_checksums_that_threads_look_at_come_first(what, of_many_bundles, choose, monkeypatch):
    """As if sections were opened one after the other: what is wrong with the first of them is told."""
    choose("native")
    monkeypatch.setattr(block_values, "_LARGE", 1)
    contexts = what.startswith("contexts")
    data = bytearray(of_many_bundles)
    begin, size = at(of_many_bundles, Property.OPACITY)
    if what != "checksum of one":
        data[begin + (8 if contexts else size // 2)] ^= 0xFF
    data = bytearray(sealed(bytes(data)))
    data[at(of_many_bundles, Property.SCALE if contexts else Property.SH1)[0] + 30] ^= 0xFF
    assert said_of(bytes(data)).startswith("section 'opacity'" if contexts else "section 'sh1' is damaged")


def test_threads_name_the_damage_that_one_thread_finds_first(of_many_bundles, choose):
    """Several bundles are damaged, in sections that are decoded early and late."""
    choose("native")
    data = bytearray(of_many_bundles)
    for prop, part in ((Property.SH1, 0.5), (Property.OPACITY, 0.9), (Property.ROTATION, 0.95)):
        begin, size = at(of_many_bundles, prop)
        place = begin + int(size * part)
        data[place : place + 8] = bytes(value ^ 0x5A for value in data[place : place + 8])
    assert said_of(sealed(bytes(data))).startswith("section 'sh1'")  # half of its words are before the damage


def files_to_change() -> list[bytes]:
    scenes = [random_scene(300, 1, seed=1), random_scene(40, 3, seed=2).subset(np.r_[np.arange(40), [5, 5, 6]])]
    made = [coded(scene) for scene in scenes] + [coded(scenes[1], "paper", entropy="zstd"), coded(scenes[0], "fast")]
    return made + [path.read_bytes() for path in GOLDEN if path.stat().st_size < 6000]


@pytest.mark.slow
def test_changed_files(choose):
    """Bytes changed anywhere behind the magic, checksums made right: read alike or refused for the same reason."""
    chance, originals, read = random.Random(7), files_to_change(), 0
    for number in range(150):
        data = bytearray(originals[number % len(originals)])
        for _ in range(chance.choice([1, 1, 1, 2, 8])):
            place = chance.randrange(int.from_bytes(data[12:16], "little"), len(data))
            data[place] = chance.choice([0, 1, 127, 128, 255, chance.getrandbits(8)])
        read += read_alike(sealed(bytes(data)), choose)
    assert 15 < read < 135  # both must occur for this to mean anything


def test_the_end_of_the_words_is_seen(choose):
    """A section whose last words are missing, in steps of every width."""
    data = coded(random_scene(300, 0, seed=4))
    refused = 0
    for name in STREAMS.keys() & {section.name for section in File.of(data).blocks[0].sections}:
        for cut in (2, 4, 20, 60):
            file = File.of(data)
            (short,) = (section for section in file.blocks[0].sections if section.name == name)
            short.stored = short.stored[:-cut]
            short.raw = len(short.stored)
            refused += not read_alike(file.bytes(), choose)
    assert refused >= 12


# The choice -----------------------------------------------------------------------------------------------------------


def test_another_word_than_0_and_1_is_refused(monkeypatch):
    monkeypatch.setenv(VARIABLE, "yes")
    with pytest.raises(UsageError, match=f"{VARIABLE} is 'yes'"):
        decode(GOLDEN[0])


@pytest.mark.parametrize("content", [None, "this is not machine code"])
def test_without_the_library(content, monkeypatch, tmp_path, caplog):
    """NumPy decodes, unless the user insists, and that it takes longer is said once."""
    library._tell_once.cache_clear()
    if content is not None:
        (tmp_path / "a.so").write_text(content)
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path / "a.so"))
    monkeypatch.delenv(VARIABLE, raising=False)
    assert native() is None
    assert len(decode(GOLDEN[0]))
    (said,) = (record.getMessage() for record in caplog.records)
    assert "python -m tools.make.native" in said
    monkeypatch.setenv(VARIABLE, "1")
    with pytest.raises(UsageError, match="compiled library is missing"):
        decode(GOLDEN[0])
