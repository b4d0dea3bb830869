"""Every option of the command line is a keyword of the function of its command, and means the same.

Each is given once on the command line and once in Python. Of commands that compute, what is asked for must be the same,
and nothing is computed; of the others, what comes out, to the last byte. Where the option has anything to do with it,
both must be other than without the option.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import inspect
import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import potr_cl
from potr_cl import Camera, Scene, cli
from potr_cl.api.choices import EncodeChoices, encode_options
from potr_cl.api.editing import EditChoices, _CompactKeywords, _PruneKeywords
from potr_cl.api.views import ViewChoices
from potr_cl.cli import command_parser
from potr_cl.formats.scenes import page
from potr_cl.host import process
from potr_cl.model.virtual_cameras import PREFIX
from potr_cl.opencl.device import Device
from potr_cl.pipeline.run import Run
from potr_cl.stages.views_between import Between
from tests.reference.scenes import ring_of_cameras

#: The commands that have a function of their name.
COMMANDS = ("encode", "prune", "compact", "refit", "fit", "decode", "info", "convert", "render", "compare")
#: Options that have no keyword, and why.
COMMAND_LINE_ONLY = {
    "--lpips": "a keyword too, of an extra that few have installed",
    "--help": "Python has its own",
    "--json": "results are objects; SceneComparison.report() and SceneInfo.facts are what it prints",
    "--quiet": "what a program is told it asks for by progress; warnings are log messages",
    "--verbose": "as --quiet",
    "--from": "for standard input",
    "--to": "for standard output and folders of scenes",
    "--skip-existing": "for folders of scenes",
    "--budget": "compare_budgets compares levels of detail, compare one scene",
    "--curve": "compare_budgets(...).write_page",
    "--ladder": "encode_ladder makes several files, encode one",
    "--cluster": "a keyword too; tests/workers/test_cluster.py compares them, with a cluster",
    "--no-quality": "judge=False, which is the default in Python unless there is a report",
}
#: Of each option its value in Python; {name} stands for a path of the test's files. :func:`typed` writes it down.
VALUES: dict[str, Any] = {
    **{f"--{name}": f"{{{name}}}" for name in ("output", "cameras", "reference", "report", "device")},
    "--order": "{order}",
    **dict.fromkeys(("--photos", "--truth"), "{photos}"),
    **dict.fromkeys(("--compact", "--one-pass", "--trust", "--antialiased", "--cameras-anyway"), True),
    "--no-prune": False,
    **dict.fromkeys(("--sf-dc", "--sf-sh", "--sf-opacity", "--sf-rotation", "--sf-scale"), 9),
    **dict.fromkeys(("--level", "--damping", "--sh-degree"), 0),
    **dict.fromkeys(("--threads", "--views-between"), 1),
    **dict.fromkeys(("--levels", "--lod-chunk-count", "--steps"), 2),
    **dict.fromkeys(("--iterations", "--turns", "--zstd-level", "--spz-version", "--turntable"), 3),
    **dict.fromkeys(("--virtual-views", "--prior"), 5),
    **dict.fromkeys(("--lod-chunk-extent", "--tolerance", "--lambda", "--alpha"), 0.5),
    **dict.fromkeys(("--quality", "--compact-at", "--beta"), 0.2),
    "--max-size": "9kB",
    "--min-psnr": 28,
    "--preset": "paper",
    "--splats": 100_000,
    "--report-view": "view_5",
    "--keep": 0.4,
    "--count": 60,
    "--delta-mse-max": 1e-4,
    "--mapping-a": 4,
    "--colour-model": "rgb",
    "--weighting": "visibility",
    "--refit": "off",
    "--fit": 80,
    "--drop": 1e-5,
    "--refit-at": [0.3, 0.6],
    "--entropy": "zstd",
    "--gamma": 0.1,
    "--block-splats": 65536,
    "--box": [-100, -100, 2.7, 100, 100, 100],
    "--title": "A title",
    "--author": "Somebody",
    "--unseen": "drop",
    "--memory": 0.25,
    "--background": (0.2, 0.4, 0.8),
    "--rules": "gsplat",
    "--views": ["view_2", 4],
    "--split": "train",
    "--up": "-x",
    "--size": 48,
}
#: What only says how the work is done, or is written besides.
SAME_RESULT = {"--threads", "--trust", "--memory", "--device", "--output", "--cameras", "--reference", "--report",
               "--report-view", "--order", "--tolerance", "--cameras-anyway", "--unseen",
               "--level", "--splats", "--lod-chunk-count", "--lod-chunk-extent"}  # fmt: skip
#: What else has to be given for an option to have anything to do.
WITH: dict[str, list[str]] = {"--report-view": ["--report"], "--compact-at": ["--compact"]}
#: Options that cannot be given with cameras.
WITHOUT_CAMERAS = {"--virtual-views", "--turntable", "--up", "--size"}


@cache
def options_of(command: str) -> list[argparse.Action]:
    parser = command_parser([command])
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return [action for action in commands.choices[command]._actions if action.option_strings]


def flag_of(action: argparse.Action) -> str:
    return next(name for name in action.option_strings if name.startswith("--"))


#: Those that serve until they are ended: their options are keywords too, what comes out is a page.
SERVING = ("view",)
CASES = [(command, flag_of(action)) for command in COMMANDS for action in options_of(command)]
CASES = [(command, flag) for command, flag in CASES if flag not in COMMAND_LINE_ONLY]


def keywords_of(command: str) -> set[str]:
    """Those in the function's own signature, and those that stand for ``**choices``."""
    signature = inspect.signature(getattr(potr_cl, command)).parameters
    own = {name for name, each in signature.items() if each.kind is not inspect.Parameter.VAR_KEYWORD}
    more = {"Unpack[EncodeChoices]": EncodeChoices, "Unpack[EditChoices]": EditChoices,
            "Unpack[ViewChoices]": ViewChoices,
            "Unpack[_PruneKeywords]": _PruneKeywords, "Unpack[_CompactKeywords]": _CompactKeywords}  # fmt: skip
    return own.union(*(more[each.annotation].__annotations__ for each in signature.values() if each.name not in own))


def keyword(command: str, flag: str) -> str:
    """What an option is called in Python, by the rule that docs/python.md states."""
    if flag == "--quality":
        return "q"
    name = flag.removeprefix("--").removeprefix("no-").replace("-", "_")
    return "lambda_" if name == "lambda" else name


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_a_keyword(command):
    for flag in [flag for of, flag in CASES if of == command]:
        assert keyword(command, flag) in keywords_of(command), (
            f"potr_cl.{command} has no keyword for {flag}: give it one, or say in COMMAND_LINE_ONLY why not"
        )
        assert flag in VALUES, f"say in VALUES what {flag} is called with"


def typed(flag: str, value: Any) -> list[str]:
    """An option as it is typed."""
    if isinstance(value, bool):
        return [flag, "yes"] if flag == "--antialiased" else [flag]
    if isinstance(value, tuple):
        return [flag, ",".join(map(str, value))]
    if str(value).startswith("-"):
        return [f"{flag}={value}"]
    return [flag, *map(str, value if isinstance(value, list) else [value])]


#: Commands that compute: what they ask for is compared.
COMPUTING = ("encode", "prune", "compact", "refit", "fit", "render", "compare")


class Asked(BaseException):
    """What would be computed, and on which device."""


def shown(value: Any) -> Any:
    """All that a value holds, to be compared."""
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, (list, tuple)):
        return [shown(each) for each in value]
    if dataclasses.is_dataclass(value):
        return [type(value).__name__, *(shown(getattr(value, field.name)) for field in dataclasses.fields(value))]
    if value is None or isinstance(value, (int, float)):
        return value
    # Who is told of progress differs, and nothing that is made depends on it.
    return None if callable(value) or isinstance(value, process.Asked) else str(value)


def asked(device: Device | None, *what: Any, **more: Any) -> None:
    raise Asked(device and device.info, shown(what), shown(list(more.items())))


@pytest.fixture
def nothing_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Instead, the seams to what computes raise :class:`Asked`; virtual cameras lie on a ring."""

    def placed(scene: Scene, count: int | None = None, device: Device | None = None) -> list[Camera]:
        return [dataclasses.replace(view, name=f"{PREFIX}{view.name}") for view in ring_of_cameras(count or 8)]

    def prepare_for(device: Device, purpose: str) -> Future[None]:
        done: Future[None] = Future()
        done.set_result(None)
        return done

    @contextlib.contextmanager
    def rasterizer(device, scene, rules=None, background=None, **how):
        yield scene, rules, background, how

    def compared(a, b, views, workers, notes, progress, **how):
        asked(workers.device, a, b, views, **how)

    monkeypatch.setattr(
        Run, "stages", lambda run, state, only=None: asked(run._given, run._options, state.scene, state.views)
    )
    monkeypatch.setattr(Device, "prepare_for", prepare_for)
    for module in ("pipeline.encode", "api.views"):
        monkeypatch.setattr(f"potr_cl.{module}.place_cameras", placed)
    for name in ("turntable", "look_around"):
        monkeypatch.setattr(f"potr_cl.api.views.{name}", lambda *given: asked(given[-1], *given[:-1]))
    for name in ("editing.refit_colours", "editing.fit_scene"):
        monkeypatch.setattr(f"potr_cl.api.{name}", asked)
    monkeypatch.setattr("potr_cl.api.editing.Rasterizer", rasterizer)
    monkeypatch.setattr("potr_cl.api.editing.RenderedTargets", lambda *given: given)
    monkeypatch.setattr(
        "potr_cl.api.editing.PhotographTargets", lambda device, truth, views: [truth.picture(view) for view in views]
    )
    monkeypatch.setattr("potr_cl.api.comparing.compare_scenes", compared)
    monkeypatch.setattr("potr_cl.api.pictures.rasterizer_for", asked)
    for module in ("comparing", "pictures"):
        monkeypatch.setattr(f"potr_cl.api.{module}.warn_of_frame", lambda *_: None)


@pytest.fixture(scope="module")
def known() -> dict[tuple[str, ...], Any]:
    """Outcomes of calls that several options are compared with."""
    return {}


def outcome(folder: Path, call: Callable[[], Any]) -> Any:
    """What is asked for, or all that a call leaves behind: files by name, and figures."""
    folder.mkdir(parents=True)
    try:
        result = call()
    except Asked as what:
        return what.args
    left: dict[str, Any] = {
        # Of a report, whose times are never the same, the headings.
        str(path.relative_to(folder)): re.findall(r"<h[23]>.*?</h[23]>", path.read_text("utf-8"))
        if path.suffix == ".html"
        else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    # But for remarks, in which the command line speaks of its own options.
    return left | {name: value for name, value in (result or {}).items() if name != "notes"}


def called(command: str, flags: list[str], files: dict[str, Path], folder: Path, capsys: Any) -> Iterator[Any]:
    """The outcome of a command with some options, from the command line and from Python."""
    sources = {"decode": ["potr"], "refit": ["reduced"], "fit": ["reduced"], "compare": ["scene", "reduced"]}
    positional = [str(files[name]) for name in sources.get(command, ["scene"])]
    suffix = {"encode": ".potr", "render": "", "compare": ".png"}.get(command, ".ply")
    suffix = ".spz" if "--spz-version" in flags else suffix
    suffix = ".html" if {"--title", "--author"} & {*flags} else suffix
    name = "lod-meta.json" if {"--lod-chunk-count", "--lod-chunk-extent"} & {*flags} else f"out{suffix}"

    def values(here: Path) -> list[tuple[str, Any]]:
        paths = {**files, "output": here / name, "report": here / "page.html", "order": here / "order.npy"}
        return [(flag, v.format(**paths) if isinstance(v := VALUES[flag], str) else v) for flag in flags]

    def from_the_command_line() -> Any:
        words = [command, *positional, *(word for each in values(folder / "typed") for word in typed(*each))]
        told = command in ("info", "compare")
        capsys.readouterr()
        code = cli.main([*words, "--json"] if told else words)
        said = capsys.readouterr()
        assert code == 0, said.err
        return json.loads(said.out) if told else None

    def from_python() -> Any:
        keywords = {keyword(command, flag): value for flag, value in values(folder / "python")}
        result = getattr(potr_cl, command)(*positional, **keywords)
        facts = {"info": "facts", "compare": "report"}.get(command)
        facts = facts and getattr(result, facts)
        return json.loads(json.dumps(facts() if callable(facts) else facts))

    yield outcome(folder / "typed", from_the_command_line)
    yield outcome(folder / "python", from_python)


def usual(command: str, flag: str) -> list[str]:
    """What a command is given besides an option."""
    available = {flag_of(action) for action in options_of(command)}
    given = [name for name in ("--output", "--reference") if name in available]
    if "--cameras" in available and flag not in WITHOUT_CAMERAS:
        given.append("--cameras")
    if flag in WITHOUT_CAMERAS and command in ("render", "compare"):
        given += ["--size"] if flag == "--virtual-views" else ["--turntable", "--size"]
    return [*given, *(name for name in WITH.get(flag, []) if name in available)]


@pytest.mark.parametrize(("command", "flag"), CASES)
def test_and_means_the_same(command, flag, files, known, tmp_path, capsys, request):
    if command in COMPUTING:
        request.getfixturevalue("nothing_is_computed")
    if flag in ("--title", "--author") and not page.TEMPLATE.exists():
        pytest.skip("the viewer of pages is not built: python -m tools.make.web")
    base = [name for name in usual(command, flag) if name != flag]
    typed, python = called(command, [*base, flag], files, tmp_path / "with", capsys)
    assert typed, "nothing came out"
    assert typed == python
    if flag in SAME_RESULT or command in ("info", "convert"):
        return
    key = (command, *base)
    if key not in known:
        known[key] = next(called(command, base, files, tmp_path / "without", capsys))
    assert typed != known[key], f"{flag} changes nothing here: the test does not see what it means"


@pytest.mark.parametrize("command", COMPUTING)
def test_the_same_is_made(command, files, tmp_path, capsys):
    more = {"encode": ["--compact"], "refit": ["--reference"], "fit": ["--reference", "--steps"]}
    flags = ["--output", "--cameras", *more.get(command, ["--background"])]
    typed, python = called(command, flags, files, tmp_path, capsys)
    assert typed == python


@pytest.mark.parametrize("command", SERVING)
def test_every_option_of_a_server_is_a_keyword(command) -> None:
    flags = {flag_of(action) for action in options_of(command)} - set(COMMAND_LINE_ONLY)
    unknown = {flag for flag in flags if keyword(command, flag) not in keywords_of(command)}
    assert not unknown


def test_a_ladder_takes_the_options_of_an_encode() -> None:
    only_of_one_file = {"--quality", "--max-size", "--min-psnr", "--report", "--report-view"}
    wanted = {
        keyword("encode", flag) for command, flag in CASES if command == "encode" and flag not in only_of_one_file
    }
    assert wanted - keywords_of("encode_ladder") == set()


def test_choices_of_stages_by_name() -> None:
    options = encode_options(None, "paper", {"mapping_a": 4, "one_pass": True, "prune": {"iterations": 7}, "refit": 3})
    assert (options.prune.mapping_a, options.prune.iterations) == (4, 7)
    assert (options.compact.two_pass, options.refit.steps) == (False, 3)
    assert not encode_options(None, "best", {"refit": False}).refit.on
    assert not encode_options(None, "best", {"prune": False}).prune.on
    assert not encode_options(None, "best", {"between": False}).stage(Between).on
    usual = encode_options(None, "best", {"refit": "auto"}).refit
    assert (usual.steps_on("cpu"), usual.steps_on("gpu")) == (6, 12)


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"iteration": 3}, "did you mean 'iterations'"),
        ({"xyzzy": 3}, "unknown option 'xyzzy'"),
        ({"entropy": "gzip"}, "choose one of"),
        ({"one_pass": 1}, "True or False"),
        ({"keep": "half"}, "invalid value"),
        ({"between": 0}, "'between' is 0: give a mapping of its options"),
        ({"keep": 1.5}, "at most 1"),
    ],
)
def test_wrong_choices(choices, said) -> None:
    with pytest.raises(potr_cl.UsageError, match=said):
        potr_cl.encode("no such file", **choices)
