"""The decoder's native path with sanitizers, fed changed files: does it touch memory that is not its own, or differ?

    python -m tools.stress.native [--count N] [--first N] [--seconds S] [--seed SEED] [--processes P] [--json FILE]
                                  [--continue] [--compare K]

Compiles potr_cl/codec/native with AddressSanitizer and UndefinedBehaviorSanitizer (gcc or clang), and has processes
decode changed .potr files with it, those of ``tools.stress.fuzz --format potr`` and some of more splats, most of them
with their checksums made right, so that deep code is reached. A process that a sanitizer ends is a finding; so is a
file that NumPy reads to other bits, or refuses for another reason (every K-th file is read by both; default: all).

Each array that the library only reads is first copied to memory of exactly its size, so that one byte beyond is seen.
--continue adds to the figures of the JSON file, and goes on with the files after the last one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np

from potr_cl.codec import block_values, plain_values
from potr_cl.codec.body import Body
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.codec.destination import BundleTaker, SceneArrays
from potr_cl.codec.native import arrays, bundles, functions, octree, share, values
from potr_cl.codec.native.library import LIBRARY_VARIABLE, VARIABLE, VECTORS_VARIABLE
from potr_cl.codec.native.values import BUNDLE, PackedValues
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder
from potr_cl.errors import DataError
from tests.reference.scenes import random_scene
from tools.make.native import compile_library
from tools.results import ROOT, Column, Results
from tools.stress.hostile import potr_files

_COLUMNS = (
    Column("files", format=","),
    Column("read", format=","),
    Column("refused", format=","),
    Column("compared with NumPy", format=","),
    Column("findings", format=","),
    Column("time", "s", ".0f"),
)
_ATTRIBUTES = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
#: Files that a process reads before it tells how far it came.
_BATCH = 500


def changed_file(seed: int, number: int) -> bytes:
    """File ``number`` of a seed: always the same."""
    rng = Random(f"{seed}/native/{number}")
    files = _originals()
    often = (*_FUZZED_HOW_OFTEN, *(max(1, 2400 // size) for _, size in _MORE))
    with patch.object(potr_files, "originals", lambda: files), patch.object(potr_files, "_HOW_OFTEN", often):
        return potr_files.changed(rng)


#: SH degree and splats of files whose integers have many bits, and whose lanes end at different steps.
_MORE = ((0, 700), (2, 90), (3, 520))


@cache
def _originals() -> list[bytes]:
    """The fuzzer's, and those."""
    files = list(_FUZZED())
    for degree, splats in _MORE:
        scene = random_scene(splats, degree, seed=splats)
        scene.sh[...] *= np.float32(40)
        # Most AC coefficients of real scenes are 0.
        scene.sh[:, 1:] *= np.random.default_rng(splats).random(scene.sh[:, 1:].shape) < 0.3
        files.append(potr_files.file_of([scene], HyperParameters.from_quality(1.0, "best"), "bundles", 1 << 20))
    return files


#: The function itself, before :func:`changed_file` puts another into its place.
_FUZZED = potr_files.originals
_FUZZED_HOW_OFTEN = potr_files._HOW_OFTEN


# ---------------------------------------------------------------------------------------------------- worker


def work(seed: int, first: int, stop: int, compare: int) -> None:
    """Decode files; print a line of JSON for each that differs, and after each batch.

    What threads work with is made once: what one file has left there must not matter to the next.
    """
    untouched = arrays.address
    kept: list[Any] = []

    def copied(array: Any, dtype: Any, number: int, writable: bool = False) -> int:
        if not writable:
            array = np.frombuffer(array.tobytes(), array.dtype).copy().reshape(array.shape)
            kept.append(array)
        return untouched(array, dtype, number, writable)

    at = os.open(os.environ["POTR_STRESS_AT"], os.O_WRONLY | os.O_CREAT)
    with (
        ExitStack() as patches,
        patch.object(plain_values, "thread_pool", _at_once),
        patch.object(bundles.BundledFile, "work", _work_again(bundles.BundledFile.work)),
        patch.object(block_values, "ThreadPoolExecutor", _OneThread),
    ):
        for module in (arrays, functions, bundles, octree, share, values):
            patches.enter_context(patch.object(module, "address", copied))
        tally = dict.fromkeys(("read", "refused", "compared"), 0)
        for number in range(first, stop):
            data = changed_file(seed, number)
            os.environ[VARIABLE] = "1"
            os.environ[VECTORS_VARIABLE] = str(number // 3 % 2)  # with and without, whatever else goes by the number
            # Levels beyond tables take another way.
            block_values._TABLE = 1 << (16 if number // 8 % 8 == 0 else 9)
            os.pwrite(at, b"%20d" % number, 0)
            try:
                file = open_file(data)
            except DataError:  # both read headers in the same way
                tally["refused"] += 1
            else:
                found = _outcome(file)
                packed = _outcome_packed(file) if number // 2 % 4 == 0 else None
                kept.clear()
                if packed not in (None, found):
                    told = {"differs": number, "native": _told(found), "numpy": f"(packed) {_told(packed or '')}"}
                    print(json.dumps(told), flush=True)
                tally["refused" if isinstance(found, str) else "read"] += 1
                if number % compare == 0:
                    os.environ[VARIABLE] = "0"
                    tally["compared"] += 1
                    if found != (wanted := _outcome(file)):
                        told = {"differs": number, "native": _told(found), "numpy": _told(wanted)}
                        print(json.dumps(told), flush=True)
            if (number + 1 - first) % _BATCH == 0 or number + 1 == stop:
                print(json.dumps({"next": number + 1, **tally}), flush=True)
                tally = dict.fromkeys(tally, 0)


class _AtOnce:
    """In place of a pool of threads, whose starts would take longer than these files."""

    def map(self, work: Callable[..., Any], items: Iterable[Any]) -> Iterator[Any]:
        return map(work, items)

    def submit(self, work: Callable[..., Any], *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(work(*args))
        except DataError as error:
            future.set_exception(error)
        return future


class _OneThread:
    """In place of pools of threads that wait for others: one that lives on."""

    _pool = ThreadPoolExecutor(1)

    def __init__(self, _: int) -> None:
        self._futures: list[Future[Any]] = []

    def submit(self, work: Callable[..., Any], *args: Any) -> Future[Any]:
        self._futures.append(self._pool.submit(work, *args))
        return self._futures[-1]

    def shutdown(self, cancel_futures: bool) -> None:
        wait(self._futures)


@contextmanager
def _at_once(_: int = 0) -> Iterator[_AtOnce]:
    yield _AtOnce()


def _work_again(made: Callable[..., Any]) -> Callable[..., Any]:
    of_thread: list[Any] = []

    def work(file: Any) -> Any:
        if not of_thread:
            of_thread.append(made(file))
        return of_thread[0]

    return work


def _outcome(file: PotrFile) -> str | dict[str, bytes]:
    try:
        scene = file.scene(threads=1)
    except DataError as error:
        return str(error)
    return {name: np.ascontiguousarray(getattr(scene, name)).tobytes() for name in _ATTRIBUTES}


def _outcome_packed(file: PotrFile) -> str | dict[str, bytes] | None:
    """Of the same by way of packed bundles, as devices are sent them; None for several blocks, or plain ones."""
    block = file.blocks[0]
    if len(file.blocks) > 1 or block.coder != Coder.BUNDLES:
        return None

    def unpack(body: Body) -> dict[str, bytes]:
        unpacked = _Unpacked(block, body.sh_count())
        body.decode_into(unpacked, threads=1)
        return {name: np.ascontiguousarray(getattr(unpacked.scene, name)).tobytes() for name in _ATTRIBUTES}

    try:
        return file.of(0, unpack)
    except DataError as error:
        return str(error)


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


def _told(outcome: str | dict[str, bytes]) -> str:
    return outcome if isinstance(outcome, str) else "reads it"


# ---------------------------------------------------------------------------------------------------- parent


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        work(*map(int, sys.argv[2:6]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, metavar="N", help="files; default 10000")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first one; default 0")
    parser.add_argument("--seconds", type=float, default=1e9, metavar="S", help="at the most")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, metavar="P", help="default: one a core")
    parser.add_argument("--compare", type=int, default=1, metavar="K", help="read every K-th file by NumPy, too")
    parser.add_argument("--compiler", metavar="CC")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    parser.add_argument("--continue", action="store_true", dest="go_on", help="add to the figures of --json")
    args = parser.parse_args()
    before = [0, 0, 0, 0, 0, 0.0]
    if args.go_on and args.json is not None and args.json.exists():
        before = json.loads(args.json.read_text())["native"]["rows"][0]
        args.first = int(before[0])
    results = Results(None, args.json)
    table = results.table("native", "Changed files, decoded by the native path with sanitizers", *_COLUMNS)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, "sanitized.so")
        compile_library(library, sanitize=True, compiler=args.compiler)
        findings = _attack(args, library, Path(folder))
    figures = [findings.files, findings.read, findings.refused, findings.compared, len(findings.told)]
    row = [a + b for a, b in zip(before, [*figures, time.monotonic() - began], strict=True)]
    table.put(*row[:-1], round(row[-1], 1))
    print("\n".join(findings.told), file=sys.stderr)
    sys.exit(1 if findings.told else 0)


class _Findings:
    def __init__(self) -> None:
        self.files = self.read = self.refused = self.compared = 0
        self.told: list[str] = []


def _attack(args: argparse.Namespace, library: Path, folder: Path) -> _Findings:
    """Share the files out over processes that read a batch each at a time; one that ends early is a finding."""
    found = _Findings()
    end = time.monotonic() + args.seconds
    # Long enough for the start of a worker not to count.
    share = max(1, min(20 * _BATCH, -(-args.count // args.processes)))
    shares = iter(range(args.first, args.first + args.count, share))
    workers: list[_Worker] = []
    while True:
        while len(workers) < args.processes and time.monotonic() < end and (first := next(shares, None)) is not None:
            stop = min(first + share, args.first + args.count)
            workers.append(_Worker(args, first, stop, library, folder))
        if not workers:
            return found
        for worker in list(workers):
            if time.monotonic() >= end:
                worker.stop()
            if worker.process.poll() is not None:
                workers.remove(worker)
                worker.add_to(found)
        time.sleep(0.2)


class _Worker:
    """A process, and the files that it reads."""

    _stopped = False

    def __init__(self, args: argparse.Namespace, first: int, stop: int, library: Path, folder: Path) -> None:
        self._seed = args.seed
        self._said = folder / f"said-{first}"
        self._at = folder / f"at-{first}"
        environment = {
            **os.environ,
            LIBRARY_VARIABLE: str(library),
            "LD_PRELOAD": _runtime(args.compiler),
            # What the library is given is copied to memory of its own; what was freed waits in a cache's worth.
            "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:allocator_may_return_null=1:quarantine_size_mb=16",
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "PYTHONPATH": os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]),
            "OPENBLAS_NUM_THREADS": "1",
            "POTR_STRESS_AT": str(self._at),
        }
        command = [sys.executable, "-m", "tools.stress.native", "--worker"]
        numbers = [args.seed, first, stop, args.compare]
        with self._said.open("w") as said:
            self.process = subprocess.Popen(
                [*command, *map(str, numbers)], stdout=said, stderr=subprocess.STDOUT, env=environment, cwd=folder
            )

    def stop(self) -> None:
        """Its batches until now count."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
            self._stopped = True

    def add_to(self, found: _Findings) -> None:
        for told in self._lines():
            if "differs" in told:
                found.told.append(
                    f"file {told['differs']} of seed {self._seed}: native: {told['native']}; NumPy: {told['numpy']}"
                )
            else:
                found.files += told["read"] + told["refused"]
                for name in ("read", "refused", "compared"):
                    setattr(found, name, getattr(found, name) + told[name])
        if self.process.returncode and not self._stopped:
            at = self._at.read_text().strip() if self._at.exists() else "?"
            found.told.append(f"file {at} of seed {self._seed} ended a process:\n{self._said.read_text()[-3000:]}")

    def _lines(self) -> Iterator[dict[str, Any]]:
        for line in self._said.read_text().splitlines():
            if line.startswith("{") and line.endswith("}"):
                yield json.loads(line)


@cache
def _runtime(compiler: str | None) -> str:
    """The sanitizer's library, which must be loaded before Python."""
    name = "libclang_rt.asan-x86_64.so" if "clang" in (compiler or "") else "libasan.so"
    found = subprocess.run(
        [compiler or "cc", f"-print-file-name={name}"], capture_output=True, text=True, check=True
    ).stdout.strip()
    if not Path(found).is_absolute():
        sys.exit(f"the compiler has no {name}: install its sanitizers")
    return found


if __name__ == "__main__":
    main()
