"""Make the generated parts of the documentation: python -m tools.make.docs [--check]

- docs/cli.md, from the command line's own parsers (argparse's help is laid out otherwise in each version of Python);
- the tables between ``<!-- generated: NAME -->`` and ``<!-- end -->`` in other pages, from the code that knows them.

The pages are committed, so that they can be read without building anything. ``--check`` writes nothing and fails if a
page is not as it would be made now.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from potr_cl.cli import command_parser
from potr_cl.formats.registry import CAMERA_FORMATS, SCENE_FORMATS
from potr_cl.opencl import quirks
from potr_cl.pipeline.presets import DEFAULT, PRESETS, PURPOSE
from potr_cl.stages.code import Code
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from tools.make.benchmarks import figures_table
from tools.results import ROOT, markdown

#: Says of a page that it is made.
NOTICE = "<!-- Made by `python -m tools.make.docs`. Do not edit this page: edit the code that it describes. -->"


def cell(text: str) -> str:
    """Text that stays in one cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def cli_page() -> str:
    """The text of docs/cli.md: every command with its arguments."""
    parser = command_parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    helps = {entry.dest: entry.help or "" for entry in commands._choices_actions}
    parts = [
        "# Command line",
        NOTICE,
        "Every command is called as `python -m potr_cl COMMAND`, or as `potr-cl COMMAND` once the package is "
        "installed. [Usage](usage.md) shows what they are for.",
        "Exit codes: 0 success; 1 bad data, a device that fails, or a target that no quality reaches; 2 wrong usage; "
        "130 interrupted, 143 terminated, 129 the terminal was closed. An output file appears only when it is "
        "whole, and never in the place of an input. Errors are one line on standard error.",
        markdown(("command", "what it does"), [(f"[`{n}`](#{n})", cell(helps[n])) for n in commands.choices]),
        "Instead of a command:",
        *_arguments(parser),
    ]
    for name, command in commands.choices.items():
        parts += [f"## {name}", _sentence(command.description or helps[name]), f"    {_usage(command)}"]
        parts += _arguments(command)
    return "\n\n".join(parts) + "\n"


def _usage(command: argparse.ArgumentParser) -> str:
    """The command with what it cannot do without."""
    words = [command.prog]
    for action in command._actions:
        if not action.option_strings:
            words.append(_value(action))
        elif action.required:
            words += [action.option_strings[0], _value(action)]
    return " ".join([*words, "[options]"])


def _arguments(command: argparse.ArgumentParser) -> Iterator[str]:
    """A table for each group of arguments, with the groups' own titles but for the two that argparse makes itself."""
    formatter = command._get_formatter()
    alone = {
        id(action): group._group_actions
        for group in command._mutually_exclusive_groups
        for action in group._group_actions
    }
    for number, group in enumerate(command._action_groups):
        rows = []
        for action in group._group_actions:
            if isinstance(action, (argparse._HelpAction, argparse._SubParsersAction)):
                continue
            text = formatter._expand_help(action) if action.help else ""
            others = [f"`{other.option_strings[-1]}`" for other in alone.get(id(action), ()) if other is not action]
            if others:
                text = f"{text} (not together with {', '.join(others)})".strip()
            rows.append((cell(_flags(action)), cell(text)))
        if rows:
            if number > 1 and group.title:
                yield f"{group.title[0].upper()}{group.title[1:]}:"
            yield markdown(("argument" if number == 0 else "option", "meaning"), rows)


def _flags(action: argparse.Action) -> str:
    """How an argument is written, with the name of its value."""
    if not action.option_strings:
        return f"`{_value(action)}`"
    value = "" if action.nargs == 0 else f" {_value(action)}"
    return ", ".join(f"`{flag}{value}`" for flag in action.option_strings)


def _value(action: argparse.Action) -> str:
    if action.choices is not None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    name = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    return f"{name} …" if action.nargs in ("+", "*") else name


def _sentence(text: str) -> str:
    text = text[0].upper() + text[1:]
    return text if text.endswith(".") else f"{text}."


def quirks_table() -> str:
    """The workarounds of potr_cl/opencl/quirks.py, for docs/architecture.md."""
    rows = [
        (f"`{name}`", *map(cell, (f"{quirk.vendor}, {quirk.versions}", quirk.reason, quirk.still_needed)))
        for name, quirk in quirks.ALL.items()
    ]
    head = ("quirk", "runtime and versions", "what goes wrong without it", "how to see if it is still needed")
    return markdown(head, rows)


#: What users have posted (docs/devices.md), and the kernels whose times a row has.
_REPORTS = ROOT / "docs" / "devices"
_KERNELS = ("project", "sort_tiles", "composite", "removal", "refit_sweep", "derivatives", "compact")


def devices_table() -> str:
    """The devices of the reports, for docs/devices.md."""
    rows = []
    for path in sorted(_REPORTS.glob("*.json")):
        report = json.loads(path.read_text("utf-8"))
        for entry in report["devices"]:
            if "check" in entry:
                said = entry.get("compiler", [])
                system = f"{report['system']}, {report['machine']}"
                runtime = f"{entry['platform']}, {entry['driver']}"
                told = (entry["name"], runtime, system, entry["check"], str(len(said)))
                rows.append([*map(cell, told), *(_per_launch(entry.get("times", {}), name) for name in _KERNELS)])
    head = ("device", "runtime and driver", "system", "self-check", "compiler warnings")
    return markdown((*head, *(f"`{name}`" for name in _KERNELS)), rows)


def _per_launch(times: dict[str, Any], kernel: str) -> str:
    """Milliseconds."""
    return f"{1e3 * times[kernel]['seconds'] / times[kernel]['launches']:.3g}" if kernel in times else ""


def formats_table() -> str:
    """All formats, for docs/formats.md: a table of scenes and one of cameras."""
    scenes = []
    for entry in SCENE_FORMATS:
        names = ", ".join(f"`{name}`" for name in (*entry.suffixes, *entry.names))
        scenes.append((f"{entry.name} ({names})", "yes", "no" if entry.save is None else "yes", entry.note))
    cameras = [(entry.name, "yes", "no", entry.note) for entry in CAMERA_FORMATS]
    columns = ["reads", "writes", "note"]
    return "\n\n".join([markdown(["scenes", *columns], scenes), markdown(["cameras", *columns], cameras)])


def presets_table() -> str:
    """The presets, for README.md."""
    rows = []
    for name, stages in PRESETS.items():
        by_name = {stage.name: stage for stage in stages}
        prune, compact, refit, code = (by_name[each] for each in ("prune", "compact", "refit", "code"))
        assert isinstance(prune, Prune)
        assert isinstance(refit, Refit)
        assert isinstance(code, Code)
        cpu, gpu = refit.steps_on("cpu"), refit.steps_on("gpu")
        on_gpu = "" if gpu == cpu else f" ({gpu} on a GPU)"
        colours = f"re-fitted together in {cpu} steps{on_gpu}" if cpu else "as they are"
        if compact.on:
            colours = "compacted splat by splat"
        # The paper's steps are stored as plain streams.
        coder = "zstd" if name == "paper" else code.entropy
        coder += f" {code.zstd_level}" if coder == "zstd" else ""
        mark = " (default)" if name == DEFAULT else ""
        rows.append((f"`{name}`{mark}", str(prune.iterations), colours, coder, PURPOSE[name]))
    return markdown(("preset", "pruning iterations", "colours", "entropy coder", "for"), rows)


#: Tables that other pages hold, and the function that makes each.
_TABLES: dict[str, Callable[[], str]] = {
    "devices": devices_table,
    "figures": figures_table,
    "formats": formats_table,
    "presets": presets_table,
    "quirks": quirks_table,
}


def generated() -> dict[Path, str]:
    """The text that each page should have."""
    pages = {ROOT / "docs" / "cli.md": cli_page()}
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        if path not in pages:
            text = path.read_text("utf-8")
            filled = with_tables(text)
            if filled != text:
                pages[path] = filled
    return pages


def with_tables(text: str) -> str:
    """A page with its generated tables made anew."""

    def table(match: re.Match[str]) -> str:
        return f"{match[1]}{_TABLES[match[2]]()}\n{match[3]}"

    return re.sub(r"(<!-- generated: (\w+) -->\n)(?:.*?)(<!-- end -->)", table, text, flags=re.DOTALL)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Make the generated parts of the documentation.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page is not current")
    args = parser.parse_args(argv)
    pages = generated()
    stale = [path for path, text in pages.items() if not path.exists() or path.read_text("utf-8") != text]
    names = ", ".join(str(path.relative_to(ROOT)) for path in stale)
    if args.check:
        if stale:
            print(f"not current: {names}: run python -m tools.make.docs and commit what it changes", file=sys.stderr)
        return 1 if stale else 0
    for path in stale:
        path.write_text(pages[path], "utf-8")
    print(f"written: {names}" if stale else "everything is current")
    return 0


if __name__ == "__main__":
    sys.exit(main())
