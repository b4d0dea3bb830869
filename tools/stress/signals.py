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

from tools.results import Results
from tools.stress.commands import Command, commands, environment, hashes, is_whole, prepare
from tools.workloads import plain_parser, processor_time

_SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: A command that has not ended so long after a signal hangs, seconds.
_PATIENCE = 30.0
_OLD = b"what was there before"


@dataclasses.dataclass
class Usual:
    """An undisturbed run: seconds, those of the processor in it, and the hashes of what it wrote."""

    seconds: float
    processor_seconds: float
    outputs: dict[str, str]


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--moments", type=int, default=500, metavar="N", help="of all commands; default 500")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--command", action="append", choices=[each.name for each in commands()], dest="names")
    args = parser.parse_args()
    chosen = [each for each in commands() if args.names is None or each.name in args.names]
    table = Results(None, args.json).table(
        "signals", "Commands ended at random moments",
        "command; usual time|s|.2f; moments; while it was writing; before its first lines or after its last; "
        "ended by the signal; done already; outputs new; left by SIGKILL; wrong",
    )  # fmt: skip
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
                moment = Moment(folder, command, usual, inputs, _SIGNALS[k % len(_SIGNALS)], rng, counts)
                found = moment.attempt()
                counts["wrong"] += bool(found)
                wrong += [f"{command.name}, seed {args.seed}, moment {k}: {moment.number.name}: {e}" for e in found]
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
        began, used = time.monotonic(), processor_time()
        done = subprocess.run(
            command.argv(), cwd=folder, env=environment(folder), capture_output=True, text=True, check=False
        )
        seconds, processor_seconds = time.monotonic() - began, processor_time() - used
        written = hashes(folder / "out")
        left = sorted(_temporary(folder))
        if done.returncode != 0 or set(written) != set(command.outputs) or left:
            raise RuntimeError(f"{command.name} fails, or leaves files: {sorted(written)} {left}\n{done.stderr}")
    return Usual(seconds, processor_seconds, written)


@dataclasses.dataclass
class Moment:
    """One start of a command, and one signal to it; ``counts`` is told what came of it."""

    folder: Path
    command: Command
    usual: Usual
    inputs: dict[str, str]
    number: signal.Signals
    rng: Random
    counts: Counter[str]

    def attempt(self) -> list[str]:
        """Start the command, end it at a random moment, and look at what there is; what is wrong, a line each."""
        _clear(self.folder)
        old = {name for name in self.command.outputs if self.rng.random() < 0.5}
        for name in old:
            (self.folder / "out" / name).write_bytes(_OLD)
        waits_for_file = self.rng.random() < 0.35
        moment = self.rng.random() * (0.02 if waits_for_file else self.usual.processor_seconds * 1.02)
        process = subprocess.Popen(
            self.command.argv(), cwd=self.folder, env=environment(self.folder), stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        try:
            while process.poll() is None:
                if waits_for_file and set(os.listdir(self.folder / "out")) - old:
                    self.counts["writing"] += 1
                    time.sleep(moment)
                    break
                if not waits_for_file and _used(process.pid) >= moment:
                    break
                time.sleep(0.0005)
            ready = _handles(process.pid, signal.SIGTERM)
            process.send_signal(self.number)
            try:
                _, said = process.communicate(timeout=_PATIENCE)
            except subprocess.TimeoutExpired:
                return [f"it did not end in {_PATIENCE:.0f} s"]
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        code = process.returncode
        self.counts["before"] += not ready and code != 0
        self.counts["done"] += code == 0
        return self._exit(code, ready, said.decode("utf-8", "replace")) + self._disk(old, code)

    def _exit(self, code: int, ready: bool, said: str) -> list[str]:
        if self.number != signal.SIGKILL and not ready:
            return []
        expected = -self.number if self.number == signal.SIGKILL else 128 + self.number
        self.counts["ended"] += code == expected
        found = [] if code in (expected, 0) else [f"exit code {code}\n{said}"]
        return found + ([f"it said\n{said}"] if "Traceback" in said or "Error" in said else [])

    def _disk(self, old: set[str], code: int) -> list[str]:
        found = ["an input was harmed"] if hashes(self.folder / "in") != self.inputs else []
        there = hashes(self.folder / "out")
        varies = not self.command.repeats or (self.command.ends_early and self.number == signal.SIGINT)
        fresh = 0
        for name in self.command.outputs:
            path = self.folder / "out" / name
            if name not in there or path.read_bytes() == _OLD:
                if (name in there) != (name in old):
                    found.append(f"'{name}' is gone, or is what it cannot be")
            elif there[name] == self.usual.outputs[name] or (varies and is_whole(path)):
                fresh += 1
            else:
                found.append(f"'{name}' is neither the old file nor the new one, {path.stat().st_size} bytes")
        self.counts["new"] += fresh == len(self.command.outputs)
        if code == 0 and fresh != len(self.command.outputs):
            found.append("it says that all went well, and did not write all")
        left = [*(set(there) - set(self.command.outputs)), *_temporary(self.folder)]
        self.counts["left"] += bool(left) and self.number == signal.SIGKILL
        return found + ([f"left behind: {', '.join(left)}"] if left and self.number != signal.SIGKILL else [])


def _clear(folder: Path) -> None:
    for name in ("out", "tmp"):
        shutil.rmtree(folder / name)
        (folder / name).mkdir()


def _used(pid: int) -> float:
    """Seconds of processor time that a process has had, in steps of some milliseconds; 0 where it is gone."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0.0
    fields = status.rpartition(")")[2].split()  # the name in brackets before may hold spaces
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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
