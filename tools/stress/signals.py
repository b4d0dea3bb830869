"""End every command that writes at random moments, and see that nothing is harmed and nothing is left.

    python -m tools.stress.signals [--moments N] [--seed SEED] [--command NAME …] [--json FILE]

Each moment starts a command on a small scene and sends SIGKILL, SIGINT, SIGTERM or SIGHUP: at a time that is drawn at
random from its usual run, or as soon as it has a file open in the folder of its output. Times are those of the
processor: on a machine that is busy with other things a run may last many times as long as the one before. Afterwards
every input must be what it was, each output absent or the old one or the whole new one, no other file may be in its
folder or in the temporary one (but after SIGKILL), and the command must have exited with 130, 143 or 129, without a
traceback. The first SIGINT may only end a fit early: the file is then another one, and whole.

A signal that comes before the program's first lines have run, or after its last, meets the interpreter, which ends as
it likes: such moments are told by /proc and counted apart; what is on the disk is checked all the same. Linux only.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from random import Random

from tools.results import Column, Results
from tools.stress.commands import Command, commands, environment, hashes, is_whole, prepare

_SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: A command that has not ended so long after a signal hangs, seconds.
_PATIENCE = 30.0
_OLD = b"what was there before"
_COLUMNS = (
    Column("command"),
    Column("usual time", "s", ".2f"),
    Column("moments"),
    Column("while it was writing"),
    Column("before its first lines or after its last"),
    Column("ended by the signal"),
    Column("done already"),
    Column("outputs new"),
    Column("left by SIGKILL"),
    Column("wrong"),
)


@dataclasses.dataclass
class Usual:
    """An undisturbed run: seconds, those of the processor in it, and the hashes of what it wrote."""

    seconds: float
    processor_seconds: float
    outputs: dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=500, metavar="N", help="of all commands; default 500")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--command", action="append", dest="names", metavar="NAME", help="default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    chosen = [each for each in commands() if args.names is None or each.name in args.names]
    if not chosen:
        parser.error(f"no such command; there are: {'; '.join(each.name for each in commands())}")
    results = Results(None, args.json)
    table = results.table("signals", "Commands ended at random moments", *_COLUMNS)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        inputs = prepare(folder)
        for number, command in enumerate(chosen):
            usual = run_usually(folder, command)
            moments = len(range(number, args.moments, len(chosen)))
            counts: Counter[str] = Counter()
            for k in range(moments):
                rng = Random(f"{args.seed}/{command.name}/{k}")
                found = try_moment(folder, command, usual, inputs, _SIGNALS[k % len(_SIGNALS)], rng, counts)
                counts["wrong"] += bool(found)
                wrong += [f"{command.name}, seed {args.seed}, moment {k}: {each}" for each in found]
            kinds = ("writing", "before", "ended", "done", "new", "left", "wrong")
            table.add(command.name, round(usual.seconds, 3), moments, *(counts[kind] for kind in kinds))
    print("\n".join(wrong), file=sys.stderr)
    sys.exit(1 if wrong else 0)


def run_usually(folder: Path, command: Command) -> Usual:
    """Run a command to its end; the second time counts, when its kernels are built.

    Raises:
        RuntimeError: it fails, or leaves something behind.
    """
    for _ in range(2):
        _clear(folder)
        began, used = time.monotonic(), _of_children()
        done = subprocess.run(
            command.argv(), cwd=folder, env=environment(folder), capture_output=True, text=True, check=False
        )
        seconds, processor_seconds = time.monotonic() - began, _of_children() - used
        written = hashes(folder / "out")
        left = sorted(_temporary(folder))
        if done.returncode != 0 or set(written) != set(command.outputs) or left:
            raise RuntimeError(f"{command.name} fails, or leaves files: {sorted(written)} {left}\n{done.stderr}")
    return Usual(seconds, processor_seconds, written)


def try_moment(
    folder: Path,
    command: Command,
    usual: Usual,
    inputs: dict[str, str],
    number: signal.Signals,
    rng: Random,
    counts: Counter[str],
) -> list[str]:
    """Start a command, end it at a random moment, and look at what there is; what is wrong, a line each."""
    _clear(folder)
    old = [name for name in command.outputs if rng.random() < 0.5]
    for name in old:
        (folder / "out" / name).write_bytes(_OLD)
    waits_for_file = rng.random() < 0.35
    moment = rng.random() * (0.02 if waits_for_file else usual.processor_seconds * 1.02)
    process = subprocess.Popen(
        command.argv(), cwd=folder, env=environment(folder), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    try:
        if waits_for_file:
            counts["writing"] += _wait_for_file(folder, process, set(old))
            time.sleep(moment)
        else:
            _wait_for_work(process, moment)
        ready = _handles(process.pid, signal.SIGTERM)
        process.send_signal(number)
        try:
            _, said = process.communicate(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            return [f"{number.name}: it did not end in {_PATIENCE:.0f} s"]
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    counts["before"] += not ready and process.returncode != 0
    found = _exit(process.returncode, number, ready, said.decode("utf-8", "replace"), counts)
    found += _disk(folder, command, usual, inputs, set(old), process.returncode, number, counts)
    return [f"{number.name} ({'writing' if waits_for_file else f'{moment:.3f} s'}): {each}" for each in found]


def _exit(code: int, number: signal.Signals, ready: bool, said: str, counts: Counter[str]) -> list[str]:
    if code == 0:
        counts["done"] += 1
    if number == signal.SIGKILL:
        counts["ended"] += code != 0
        return [] if code in (-number, 0) else [f"exit code {code}\n{said}"]
    if not ready:
        return []
    counts["ended"] += code == 128 + number
    found = []
    if code not in (128 + number, 0):
        found.append(f"exit code {code}\n{said}")
    if "Traceback" in said or "Error" in said:
        found.append(f"it said\n{said}")
    return found


def _disk(
    folder: Path,
    command: Command,
    usual: Usual,
    inputs: dict[str, str],
    old: set[str],
    code: int,
    number: signal.Signals,
    counts: Counter[str],
) -> list[str]:
    found = []
    if hashes(folder / "in") != inputs:
        found.append("an input was harmed")
    there = hashes(folder / "out")
    varies = not command.repeats or (command.ends_early and number == signal.SIGINT)
    fresh = 0
    for name in command.outputs:
        path = folder / "out" / name
        if name not in there:
            if name in old:
                found.append(f"'{name}' is gone")
        elif path.read_bytes() == _OLD:
            if name not in old:
                found.append(f"'{name}' is not what it can be")
        elif there[name] == usual.outputs[name] or (varies and is_whole(path)):
            fresh += 1
        else:
            found.append(f"'{name}' is neither the old file nor the new one, {path.stat().st_size} bytes")
    counts["new"] += fresh == len(command.outputs)
    if code == 0 and fresh != len(command.outputs):
        found.append("it says that all went well, and did not write all")
    left = [*(set(there) - set(command.outputs)), *_temporary(folder)]
    if left and number == signal.SIGKILL:
        counts["left"] += 1
    elif left:
        found.append(f"left behind: {', '.join(left)}")
    return found


def _clear(folder: Path) -> None:
    for name in ("out", "tmp"):
        shutil.rmtree(folder / name)
        (folder / name).mkdir()


def _wait_for_file(folder: Path, process: subprocess.Popen[bytes], there: set[str]) -> bool:
    """Wait until a file appears beside the output that was not there; whether one did."""
    while process.poll() is None:
        if set(os.listdir(folder / "out")) - there:
            return True
        time.sleep(0.0005)
    return False


def _wait_for_work(process: subprocess.Popen[bytes], seconds: float) -> None:
    """Wait until a process has had the processors for so long, or has ended."""
    while process.poll() is None and _used(process.pid) < seconds:
        time.sleep(0.0005)


def _used(pid: int) -> float:
    """Seconds of processor time that a process has had, in steps of some milliseconds; 0 where it is gone."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0.0
    fields = status.rpartition(")")[2].split()  # the name in brackets before may hold spaces
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _of_children() -> float:
    """Seconds of processor time of all processes that were started here and have ended."""
    times = os.times()
    return times.children_user + times.children_system


def _temporary(folder: Path) -> set[str]:
    """Files and folders in the temporary folder."""
    return {str(path.relative_to(folder / "tmp")) for path in (folder / "tmp").rglob("*")}


def _handles(pid: int, number: signal.Signals) -> bool:
    """Whether a process has a handler of its own for a signal."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    caught = next((line.split()[1] for line in status.splitlines() if line.startswith("SigCgt")), "0")
    return bool(int(caught, 16) >> (number - 1) & 1)


if __name__ == "__main__":
    main()
