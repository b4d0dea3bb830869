"""Every option of the command line is a keyword of the function of its command, and means the same.

Each is given once on the command line and once in Python. Of commands that compute long, what is asked for must be the
same, and nothing is computed; of the others, what comes out, to the last byte. Where the option has anything to do with
it, both must be other than without the option.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import inspect
import json
import re
from concurrent.futures import Future
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
from potr_cl.opencl.discovery import list_devices
from potr_cl.pipeline.run import Run
from potr_cl.stages.stage import State
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
#: Of each option what is typed, and the same in Python; {name} stands for a path of the test's files. What has the
#: command's name in front is for that command alone.
VALUES: dict[str, tuple[list[str], Any]] = {
    "--output": (["{output}"], "{output}"),
    "--cameras": (["{cameras}"], "{cameras}"),
    "--reference": (["{reference}"], "{reference}"),
    "--quality": (["0.2"], 0.2),
    "--max-size": (["9kB"], "9kB"),
    "--min-psnr": (["28"], 28),
    "--preset": (["paper"], "paper"),
    "--virtual-views": (["5"], 5),
    "--levels": (["2"], 2),
    "--lod-chunk-count": (["2"], 2),
    "--lod-chunk-extent": (["0.5"], 0.5),
    "--level": (["0"], 0),
    "--splats": (["100000"], 100_000),
    "--report": (["{report}"], "{report}"),
    "--report-view": (["view_5"], "view_5"),
    "--order": (["{order}"], "{order}"),
    "--no-prune": ([], False),
    "--keep": (["0.4"], 0.4),
    "--count": (["60"], 60),
    "--delta-mse-max": (["1e-4"], 1e-4),
    "--iterations": (["3"], 3),
    "--tolerance": (["0.5"], 0.5),
    "--turns": (["3"], 3),
    "--damping": (["0"], 0),
    "--mapping-a": (["4"], 4),
    "--compact": ([], True),
    "--compact-at": (["0.2"], 0.2),
    "--lambda": (["0.5"], 0.5),
    "--alpha": (["0.5"], 0.5),
    "--colour-model": (["rgb"], "rgb"),
    "--weighting": (["visibility"], "visibility"),
    "--one-pass": ([], True),
    "--refit": (["off"], "off"),
    "--fit": (["80"], 80),
    "--drop": (["1e-5"], 1e-5),
    "--refit-at": (["0.3", "0.6"], [0.3, 0.6]),
    "--photos": (["{photos}"], "{photos}"),
    "--truth": (["{photos}"], "{photos}"),
    "--entropy": (["zstd"], "zstd"),
    "--zstd-level": (["3"], 3),
    "--gamma": (["0.1"], 0.1),
    "--beta": (["0.2"], 0.2),
    "--sf-dc": (["9"], 9),
    "--sf-sh": (["9"], 9),
    "--sf-opacity": (["9"], 9),
    "--sf-rotation": (["9"], 9),
    "--sf-scale": (["9"], 9),
    "--block-splats": (["65536"], 65536),
    "--steps": (["2"], 2),
    "--prior": (["5"], 5),
    "--threads": (["1"], 1),
    "--trust": ([], True),
    "--antialiased": (["yes"], True),
    "--sh-degree": (["1"], 1),
    "--box": (["-100", "-100", "2.7", "100", "100", "100"], [-100, -100, 2.7, 100, 100, 100]),
    "--spz-version": (["3"], 3),
    "--title": (["A title"], "A title"),
    "--author": (["Somebody"], "Somebody"),
    "--cameras-anyway": ([], True),
    "--unseen": (["drop"], "drop"),
    "--views-between": (["1"], 1),
    "--memory": (["0.25"], 0.25),
    "--background": (["0.2,0.4,0.8"], (0.2, 0.4, 0.8)),
    "--device": (["{device}"], "{device}"),
    "--rules": (["gsplat"], "gsplat"),
    "--views": (["view_2", "4"], ["view_2", 4]),
    "--split": (["train"], "train"),
    "--turntable": (["3"], 3),
    "--up": (["=-x"], "-x"),
    "--size": (["48"], 48),
}
#: What only says how the work is done.
SAME_RESULT = {"--threads", "--trust", "--memory", "--device", "--output", "--cameras", "--reference", "--report",
               "--report-view", "--order", "--tolerance", "--cameras-anyway", "--unseen",
               "--level", "--splats", "--lod-chunk-count", "--lod-chunk-extent"}  # fmt: skip
#: What else has to be given for an option to have anything to do.
WITH: dict[str, list[str]] = {"--report-view": ["--report"], "--compact-at": ["--compact"]}
#: Options that cannot be given with cameras.
WITHOUT_CAMERAS = {"--virtual-views", "--turntable", "--up", "--size"}


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


@pytest.fixture(scope="module")
def files(tmp_path_factory, data) -> dict[str, Path]:
    """What the commands are given: a part of the excerpt, and some of its views, small."""
    folder = tmp_path_factory.mktemp("given")
    views = json.loads((data / "plush_excerpt_cameras.json").read_text())
    tests = [view for view in views if view["split"] == "test"]
    few = [*[view for view in views if view["split"] == "train"][:5], *tests[:2]]
    for number, view in enumerate(few):
        factor = 48 / max(view["width"], view["height"])
        view["img_name"] = f"view_{number}"
        for name in ("fx", "fy"):
            view[name] *= factor
        view["width"], view["height"] = round(view["width"] * factor), round(view["height"] * factor)
    cameras = folder / "cameras.json"
    cameras.write_text(json.dumps(few))
    scene = potr_cl.read_scene(data / "plush_excerpt.ply")
    scene = scene.subset(np.arange(0, len(scene), 5))
    potr_cl.save(scene, folder / "scene.ply")
    reduced = scene.subset(np.arange(0, len(scene), 2))
    potr_cl.save(reduced, folder / "reduced.ply")
    potr_cl.encode(scene, prune=False, refit=False, compact=False, q=0.3, output=folder / "scene.potr")
    potr_cl.render(folder / "reduced.ply", cameras, output=folder / "photos")
    chosen = Device().info
    index = next(str(k) for k, info in enumerate(list_devices()) if info == chosen)
    return {
        "scene": folder / "scene.ply",
        "reduced": folder / "reduced.ply",
        "reference": folder / "scene.ply",
        "potr": folder / "scene.potr",
        "cameras": cameras,
        "photos": folder / "photos",
        "device": Path(index),
    }


#: Commands that compute long: what they ask for is compared.
RUN_STAGES = ("encode", "prune", "compact", "refit", "fit")


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

    def stages(run: Run, state: State, only: Any = None) -> None:
        asked(run._given, run._options, state.scene, state.views)

    def prepare_for(device: Device, purpose: str) -> Future[None]:
        done: Future[None] = Future()
        done.set_result(None)
        return done

    monkeypatch.setattr(Run, "stages", stages)
    monkeypatch.setattr(Device, "prepare_for", prepare_for)
    for module in ("pipeline.encode", "api.views"):
        monkeypatch.setattr(f"potr_cl.{module}.place_cameras", placed)
    for name in ("turntable", "look_around"):
        monkeypatch.setattr(f"potr_cl.api.views.{name}", lambda *given: asked(given[-1], *given[:-1]))
    for name in ("refit_colours", "fit_scene"):
        monkeypatch.setattr(f"potr_cl.api.editing.{name}", asked)
    monkeypatch.setattr(
        "potr_cl.api.editing.Rasterizer",
        lambda device, scene, **how: contextlib.nullcontext((scene, list(how.items()))),
    )
    monkeypatch.setattr("potr_cl.api.editing.RenderedTargets", lambda *given: given)
    monkeypatch.setattr(
        "potr_cl.api.editing.PhotographTargets", lambda device, truth, views: [truth.picture(view) for view in views]
    )


@pytest.fixture(scope="module")
def known() -> dict[tuple[str, ...], Any]:
    """Outcomes of calls that several options are compared with."""
    return {}


def outcome(folder: Path, result: Any) -> dict[str, Any]:
    """All that a call leaves behind: files by name, and figures."""
    left: dict[str, Any] = {
        str(path.relative_to(folder)): headings(path) if path.suffix == ".html" else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    return left | ({"figures": result} if result is not None else {})


def figures(report: dict[str, Any]) -> dict[str, Any]:
    """A report but for its remarks, in which the command line speaks of its own options."""
    return {name: value for name, value in report.items() if name != "notes"}


def headings(page: Path) -> list[str]:
    """Of a report, whose times are never the same."""
    return re.findall(r"<h[23]>.*?</h[23]>", page.read_text("utf-8"))


def called(command: str, flags: list[str], files: dict[str, Path], folder: Path, capsys: Any) -> tuple[Any, Any]:
    """The outcome of a command with some options, from the command line and from Python."""
    outcomes = []
    for side in ("typed", "python"):
        here = folder / side
        here.mkdir(parents=True)
        suffix = {"encode": ".potr", "render": "", "compare": ".png"}.get(command, ".ply")
        suffix = ".spz" if "--spz-version" in flags else suffix
        suffix = ".html" if {"--title", "--author"} & {*flags} else suffix
        name = "lod-meta.json" if {"--lod-chunk-count", "--lod-chunk-extent"} & {*flags} else f"out{suffix}"
        names = {**files, "output": here / name, "report": here / "page.html", "order": here / "order.npy"}
        paths = {name: str(path) for name, path in names.items()}
        sources = {"decode": ["potr"], "refit": ["reduced"], "fit": ["reduced"], "compare": ["scene", "reduced"]}.get(
            command, ["scene"]
        )
        positional = [paths[name] for name in sources]
        if side == "typed":
            words = [command, *positional]
            for flag in flags:
                values = [value.format(**paths) for value in VALUES[flag][0]]
                words += [flag + values[0]] if values and values[0].startswith("=") else [flag, *values]
            if command in ("info", "compare"):
                words.append("--json")
            capsys.readouterr()
            try:
                assert cli.main(words) == 0, capsys.readouterr().err
            except Asked as what:
                outcomes.append(what.args)
                continue
            out = capsys.readouterr().out
            outcomes.append(outcome(here, figures(json.loads(out)) if "--json" in words else None))
        else:
            given: dict[str, Any] = {}
            for flag in flags:
                value = VALUES[flag][1]
                given[keyword(command, flag)] = value.format(**paths) if isinstance(value, str) else value
            try:
                result = getattr(potr_cl, command)(*positional, **given)
            except Asked as what:
                outcomes.append(what.args)
                continue
            facts = result.facts if command == "info" else result.report() if command == "compare" else None
            outcomes.append(outcome(here, facts and figures(json.loads(json.dumps(facts)))))
    return outcomes[0], outcomes[1]


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
    if command in RUN_STAGES or flag in WITHOUT_CAMERAS:
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
        known[key], _ = called(command, base, files, tmp_path / "without", capsys)
    assert typed != known[key], f"{flag} changes nothing here: the test does not see what it means"


@pytest.mark.parametrize("command", RUN_STAGES)
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
    assert encode_options(None, "best", {"refit": "auto"}).refit.steps == 8


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"iteration": 3}, "did you mean 'iterations'"),
        ({"xyzzy": 3}, "unknown option 'xyzzy'"),
        ({"entropy": "gzip"}, "choose one of"),
        ({"one_pass": 1}, "True or False"),
        ({"keep": "half"}, "invalid value"),
        ({"keep": 1.5}, "at most 1"),
    ],
)
def test_wrong_choices(choices, said) -> None:
    with pytest.raises(potr_cl.UsageError, match=said):
        potr_cl.encode("no such file", **choices)
