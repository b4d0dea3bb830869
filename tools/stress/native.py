"""The decoder's native path with sanitizers, fed changed files: does it touch memory that is not its own, or differ?

    python -m tools.stress.native [--count N] [--seconds S] [--seed SEED] [--processes P] [--json FILE] …

As tools.stress.fuzz, whose options it has, with potr_cl/native compiled with AddressSanitizer and
UndefinedBehaviorSanitizer (gcc or clang). Files are those of its format potr, and some of more splats. A process that a
sanitizer ends is a finding; so is a file that NumPy, or the way by packed bundles that devices take, reads to other
bits or refuses for another reason.

Each array that the library only reads is first copied to memory of exactly its size, so that one byte beyond is seen.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from potr_cl.codec import block_values
from potr_cl.codec.body import Body
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.codec.dequantizer import BundleTaker, SceneArrays
from potr_cl.codec.native import bundles, octree, values
from potr_cl.codec.native.values import BUNDLE, PackedValues
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder
from potr_cl.errors import DataError
from potr_cl.model.scene import Scene
from potr_cl.native import declarations, library
from potr_cl.native.library import LIBRARY_VARIABLE, VARIABLE, VECTORS_VARIABLE
from tests.reference.scenes import random_scene
from tools.make.native import compile_library
from tools.stress.fuzz import campaign, fuzz_parser
from tools.stress.hostile import potr_files
from tools.stress.hostile.changes import Files
from tools.stress.hostile.formats import MIB, Format, WrongResult, parts_of

#: SH degree and splats of files whose integers have many bits, and whose lanes end at different steps.
_MORE = ((0, 700), (2, 90), (3, 520))


@cache
def _originals() -> list[bytes]:
    """The fuzzer's files, and those."""
    files = list(potr_files.originals())
    for degree, splats in _MORE:
        scene = random_scene(splats, degree, seed=splats)
        scene.sh[...] *= np.float32(40)
        # Most AC coefficients of real scenes are 0.
        scene.sh[:, 1:] *= np.random.default_rng(splats).random(scene.sh[:, 1:].shape) < 0.3
        files.append(potr_files.file_of([scene], HyperParameters.from_quality(1.0, "best"), "bundles", 1 << 20))
    return files


def _make(rng: Random) -> Files:
    often = (*potr_files.HOW_OFTEN, *(max(1, 2400 // size) for _, size in _MORE))
    return {"a.potr": rng.choices(_originals(), often)[0]}


def _read(path: Path) -> Any:
    """A file by the native path, and by the others, to the same."""
    data = path.read_bytes()
    turn = zlib.crc32(data[::3])
    with_exact_arrays()
    os.environ |= {VARIABLE: "1", VECTORS_VARIABLE: str(turn & 1)}
    # Levels beyond tables take another way.
    block_values._TABLE = 1 << (16 if turn & 14 == 0 else 9)
    file = open_file(data)
    native = _outcome(lambda: parts_of(file.scene(threads=1)))
    if turn & 48 == 0 and file.blocks[0].coder == Coder.BUNDLES and len(file.blocks) == 1:
        _same(native, _outcome(lambda: file.of(0, partial(_unpacked, file))), "packed")
    _kept.clear()
    os.environ[VARIABLE] = "0"
    _same(native, _outcome(lambda: parts_of(file.scene(threads=1))), "NumPy")
    if isinstance(native, str):
        raise DataError(native)
    return native


FORM = Format(_make, potr_files.changed, _read, 512 * MIB, 1 << 16)


def _outcome(work: Callable[[], list[bytes]]) -> list[bytes] | str:
    try:
        return work()
    except DataError as error:
        return str(error)


def _same(native: list[bytes] | str, other: list[bytes] | str, way: str) -> None:
    if native != other:
        told = [each if isinstance(each, str) else "reads it" for each in (native, other)]
        raise WrongResult(f"native: {told[0]}; {way}: {told[1]}")


class _Unpacked(BundleTaker, SceneArrays):
    """The arrays of a scene that takes packed bundles."""

    def expect_bundles(self) -> None:
        assert self.values.sh is not None
        self.values.sh[...] = 0

    def take_bundle(self, first: int, packed: PackedValues, items: int) -> None:
        own = self.values.part(first, first + BUNDLE)
        assert own.log_scales is not None
        assert own.quaternions is not None
        assert own.logits is not None
        assert own.sh is not None
        n = len(own.logits)
        own.log_scales[...], own.quaternions[...] = packed.log_scales[:, :n].T, packed.quaternions[:, :n].T
        own.logits[...], own.sh[0] = packed.logits[:n], packed.dc[:, :n]
        some = packed.items[:items]
        own.sh[some[:, 0] // BUNDLE, :, some[:, 0] % BUNDLE] = some[:, 1:].copy().view(np.float32)


def _unpacked(file: PotrFile, body: Body) -> list[bytes]:
    made = _Unpacked(file.blocks[0], body.sh_count())
    body.decode_into(made, threads=1)
    scene: Scene = made.scene
    return parts_of(scene)


#: What the library is given of the file at work.
_kept: list[Any] = []


@cache
def with_exact_arrays() -> None:
    """From now on the library reads copies of exact sizes, and what threads work with is made once: what one file has
    left there must not matter to the next."""
    untouched, made, of_thread = declarations.address, bundles.BundledFile.work, list[Any]()

    def copied(array: Any, dtype: Any, number: int, writable: bool = False) -> int:
        if not writable:
            array = np.frombuffer(array.tobytes(), array.dtype).copy().reshape(array.shape)
            _kept.append(array)
        return untouched(array, dtype, number, writable)

    def work(file: Any) -> Any:
        if not of_thread:
            of_thread.append(made(file))
        return of_thread[0]

    for module in (library, bundles, octree, values):
        module.address = copied  # type: ignore[attr-defined]
    bundles.BundledFile.work = work  # type: ignore[assignment, method-assign]


def sanitizers(library: Path, compiler: str | None = None) -> dict[str, str]:
    """The environment of a process that decodes with a library that :func:`compile_library` has sanitized.

    Raises:
        SystemExit: the compiler has no sanitizers.
    """
    name = "libclang_rt.asan-x86_64.so" if "clang" in (compiler or "") else "libasan.so"
    asked = [compiler or "cc", f"-print-file-name={name}"]
    found = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    if not Path(found).is_absolute():
        sys.exit(f"the compiler has no {name}: install its sanitizers")
    return {
        LIBRARY_VARIABLE: str(library),
        "LD_PRELOAD": found,
        # What the library is given is copied to memory of its own; what was freed waits in a cache's worth.
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:allocator_may_return_null=1:quarantine_size_mb=16",
        "UBSAN_OPTIONS": "print_stacktrace=1:abort_on_error=1",
    }


def main() -> None:
    parser = fuzz_parser(__doc__)
    parser.add_argument("--compiler", metavar="CC")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, "sanitized.so")
        compile_library(library, sanitize=True, compiler=args.compiler)
        sys.exit(campaign("native", ["native"], args, sanitizers(library, args.compiler)))


if __name__ == "__main__":
    main()
