"""How a process ends: told by a signal it leaves nothing behind and says so in one line; at once, with nothing lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from potr_cl.host import process

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")

ROOT = Path(__file__).parents[2]
SIGNALS = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]


def run(program, *arguments, **options):
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": ROOT} | options
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, text=True, timeout=300, check=False, **options)


#: Sends itself a signal while it writes a file and has a temporary folder with things in it.
WRITING = """
import os, signal, sys
from pathlib import Path
from potr_cl.host.atomic_write import replacing
from potr_cl.host.leftovers import temporary_folder
from potr_cl.host import process
process.PATIENCE = float(sys.argv[3])
process.end_cleanly_on_signals()
number = getattr(signal, sys.argv[1])
with process.unwinding(), replacing(sys.argv[2]) as file, temporary_folder() as folder:
    (Path(folder) / "inner").mkdir()
    (Path(folder) / "inner" / "file").write_bytes(b"x")
    file.write(b"half")
    file.flush()
    print(folder, flush=True)
    how = sys.argv[4]
    try:
        os.kill(os.getpid(), number)
    except BaseException as error:
        if how == "raised":
            raise
        if how == "turned into another":
            raise ImportError("no such library") from error
    if how == "swallowed":
        import time
        time.sleep(30)
    if how == "twice":
        os.kill(os.getpid(), number)
    print("went on", flush=True)
"""


def one_line(said):
    return said.startswith("potr-cl: ") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("number", "code", "how"),
    [(*each, "raised") for each in SIGNALS]
    + [(signal.SIGTERM, 143, "turned into another"), (signal.SIGTERM, 143, "swallowed"), (signal.SIGINT, 130, "twice")],
)
def test_nothing_is_left(tmp_path, number, code, how):
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")
    result = run(WRITING, number.name, target, 0.1 if how == "swallowed" else 30, how)
    assert result.returncode == code
    assert one_line(result.stderr)
    folder = result.stdout.strip()
    assert os.path.isabs(folder)
    assert not os.path.exists(folder)
    assert os.listdir(tmp_path) == ["out.bin"]
    assert target.read_bytes() == b"old"


def test_what_is_ignored_stays_ignored(tmp_path):
    """As nohup asks for."""
    program = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n" + WRITING
    result = run(program, "SIGHUP", tmp_path / "out", 1, "raised")
    assert result.returncode == 0
    assert "went on" in result.stdout
    assert (tmp_path / "out").read_bytes() == b"half"


#: Works in rounds; sends itself signals in the second.
ASKED = """
import os, signal, sys
from potr_cl.host import process
from potr_cl.host.atomic_write import replacing
process.end_cleanly_on_signals()
with process.unwinding(), replacing(sys.argv[1]) as file:
    with process.first_interrupt_asks() as asked:
        for number in range(9):
            if asked:
                break
            if number == 1:
                for name in sys.argv[2:]:
                    os.kill(os.getpid(), getattr(signal, name))
    file.write(b"%d" % number)
"""


def test_threads_are_not_asked():
    """Work of the main thread is, also while another thread's begins and ends."""
    with process.first_interrupt_asks() as asked, ThreadPoolExecutor(1) as threads:

        def work():
            with process.first_interrupt_asks() as other:
                process._handle(signal.SIGINT, None)
                return bool(other)

        assert not threads.submit(work).result()
        assert asked


def test_the_first_interrupt_asks_and_the_work_goes_on(tmp_path):
    result = run(ASKED, tmp_path / "out", "SIGINT")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "out").read_bytes() == b"2"
    assert one_line(result.stderr)
    assert "interrupted: " in result.stderr


@pytest.mark.parametrize(("sent", "code"), [(("SIGINT", "SIGINT"), 130), (("SIGTERM",), 143), (("SIGHUP",), 129)])
def test_a_second_interrupt_and_any_other_signal_end_it(tmp_path, sent, code):
    result = run(ASKED, tmp_path / "out", *sent)
    assert result.returncode == code, result.stderr
    assert "no file is left half written" in result.stderr
    assert not list(tmp_path.iterdir())


def test_nobody_is_asked_after_the_work_or_in_a_program_that_has_its_own_way_with_signals(tmp_path):
    program = ASKED.replace("    file.write", "    os.kill(os.getpid(), signal.SIGINT)\n    file.write")
    result = run(program, tmp_path / "out")
    assert result.returncode == 130, result.stderr
    result = run(ASKED.replace("process.end_cleanly_on_signals()", ""), tmp_path / "out", "SIGINT")
    assert "KeyboardInterrupt" in result.stderr
    assert not list(tmp_path.iterdir())


#: Runs the program as python -m does, with a signal at the moment that a module is first asked for.
WHILE_IMPORTING = """
import os, runpy, signal, sys
name, number, *arguments = sys.argv[1:]

class Finder:
    def find_spec(self, fullname, path=None, target=None):
        if fullname == name:
            os.kill(os.getpid(), getattr(signal, number))

sys.meta_path.insert(0, Finder())
sys.argv = ["potr-cl", *arguments]
runpy.run_module("potr_cl", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(
    ("number", "code", "module"),
    [(*SIGNALS[1], "potr_cl.cli"), (*SIGNALS[0], "argparse"), (*SIGNALS[0], "potr_cl.codec.decoder")],
)
def test_while_modules_are_imported(number, code, module):
    result = run(WHILE_IMPORTING, module, number.name, "info", "nothing.potr")
    assert result.returncode == code, result.stderr
    assert one_line(result.stderr)


def test_a_converter_that_is_told_to_end(tmp_path, data):
    """At the moment when all of the file is written but its checksum."""
    program = (
        "import os, signal, sys; from potr_cl.host.process import end_cleanly_on_signals; end_cleanly_on_signals();"
        "import zlib; zlib.crc32 = lambda *_: os.kill(os.getpid(), signal.SIGTERM);"
        "from potr_cl.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    temporary, target = tmp_path / "temporary", tmp_path / "out.spz"
    temporary.mkdir()
    environment = os.environ | {"TMPDIR": str(temporary)}
    result = run(program, "convert", data / "plush_excerpt.ply", target, env=environment)
    assert result.returncode == 143, result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("closed", [(1,), (0, 1, 2)])
def test_closed_standard_files_are_not_written_to_by_accident(tmp_path, closed):
    program = (
        "import os, sys; from potr_cl.host.process import open_standard_files; open_standard_files();"
        "file = open(sys.argv[1], 'wb'); assert file.fileno() > 2; os.write(1, b'x'); os.write(2, b'y');"
        "print('z', file=sys.stderr); print('z'); file.write(b'content')"
    )
    # The shell closes them: whoever opens next would get their numbers.
    redirections = " ".join(f"{number}>&-" for number in closed)
    subprocess.run(
        ["sh", "-c", f'exec "$0" -c "$1" "$2" {redirections}', sys.executable, program, str(tmp_path / "file")],
        cwd=ROOT, check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    assert (tmp_path / "file").read_bytes() == b"content"


ENDING = "import sys\nfrom potr_cl.host.process import end_at_once\n"


@pytest.mark.parametrize("code", [0, 130])
def test_the_process_ends_with_its_code_and_nothing_is_lost(code):
    done = run(
        ENDING + "import atexit\natexit.register(lambda: print('at the end', flush=True))\n"
        f"sys.stdout.write('x' * 100000 + '\\n')\nsys.stderr.write('told')\nend_at_once({code})\nprint('never')"
    )
    assert (done.returncode, done.stderr) == (code, "told")
    assert done.stdout == "x" * 100000 + "\nat the end\n"


def test_work_that_goes_on_is_waited_for():
    done = run(
        ENDING + "import threading, time\n"
        "threading.Thread(target=lambda: (time.sleep(0.3), print('done'))).start()\n"
        "end_at_once(0)\nprint('an ordinary end')"
    )
    assert (done.returncode, done.stdout) == (0, "an ordinary end\ndone\n")


def test_a_profiler_is_not_cheated_of_its_result(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(ENDING + "end_at_once(0)\nprint('an ordinary end')\n")
    command = [sys.executable, "-m", "cProfile", "-o", str(tmp_path / "profile"), str(program)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300, env=environment)
    assert done.stdout == "an ordinary end\n"
    assert (tmp_path / "profile").stat().st_size > 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device here")
def test_what_cannot_be_written_is_told_by_an_ordinary_end():
    with open("/dev/full", "w") as full:
        done = run(ENDING + "print('x')\nend_at_once(0)", stdout=full)
    assert done.returncode != 0
    assert "No space left" in done.stderr
