"""One scene or several in one call (:func:`for_each_scene`): where each goes, and what happens if one of them fails."""

from __future__ import annotations

import argparse
import copy
import glob
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

from potr_cl.cli.guard import ReadFile, StandardInput, StandardOutput, WrittenFile, WrittenFolder, check_files
from potr_cl.cli.outputs import check_file, check_name, suffix_of
from potr_cl.cli.scenes import TO_HELP
from potr_cl.cli.terminal import duration, megabytes, note, say_done, say_line
from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import registry
from potr_cl.formats.registry import bytes_of_scene
from potr_cl.host.atomic_write import make_folder
from potr_cl.plain_text import plain


@dataclass(frozen=True)
class Row:
    """What the closing table says of a scene: bytes before and after, and PSNR."""

    before: int
    after: int
    psnr: str


#: What is done with each scene: it gets the command's arguments with ``scene`` and ``output`` of one scene alone.
Work = Callable[[argparse.Namespace], Row | None]


class SomeFailedError(PotrError):
    """Some scenes of several failed; each of them has been told already."""


def add_to_option(p: argparse._ActionsContainer) -> None:
    """``--to``, for every command that may write scenes where their names do not tell the format."""
    p.add_argument("--to", metavar="SUFFIX", help=TO_HELP)


def add_batch_options(p: argparse._ActionsContainer) -> None:
    """What every command understands that takes several scenes."""
    add_to_option(p)
    p.add_argument("--skip-existing", action="store_true", help="skip scenes whose output file exists")


def jobs(args: argparse.Namespace, kind: type[WrittenFile], suffix: str | None) -> list[argparse.Namespace]:
    """The command's arguments for each scene alone, all outputs checked; those left out whose output is to be kept.

    Args:
        args: ``scenes`` and ``output``; ``to``, where the command has it.
        kind: of file that is written.
        suffix: of the files, where neither their names nor ``--to`` tell it; None: one of these must.

    Raises:
        UsageError: two scenes would go to one file, an output is an input, or cannot be written.
    """
    output = args.output
    sources = args.scenes = _expanded(args.scenes)
    to = getattr(args, "to", None)
    wanted = suffix_of(args) if to is not None else suffix
    if isinstance(output, StandardOutput) and len(sources) > 1:
        raise UsageError(f"standard output takes one scene, not {len(sources)}: give -o a folder")
    if isinstance(output, StandardOutput):
        targets: list[Path] = [output]
    elif isinstance(output, WrittenFolder) or (len(sources) > 1 and not os.path.lexists(output)):
        targets = list(_in_folder(args, kind, wanted))
    elif len(sources) > 1:
        raise UsageError(f"{len(sources)} scenes need a folder, and '{output}' is a file")
    else:
        if to is not None:
            raise UsageError(f"'{output}' already gives the format: --to is for folders and standard output")
        targets = [kind(output)]
        check_file(kind(output))
    if isinstance(output, StandardOutput) and wanted is None:
        raise UsageError("--to is missing: standard output has no name that tells the format")
    works = [_alone(args, source, target, wanted) for source, target in zip(sources, targets, strict=True)]
    if not args.skip_existing:
        return works
    left = [one for one in works if not os.path.lexists(one.output)]
    if len(left) < len(works):
        note(f"skipping {len(works) - len(left)} of {len(works)} scenes: their output exists")
    return left


def for_each_scene(works: Sequence[argparse.Namespace], work: Work, tells_json: bool = False) -> None:
    """Do the same with each scene; if one of several fails, say why in one line and go on with the next.

    Args:
        works: of :func:`jobs`.
        work: what is done; of a single scene whatever it raises is the command's own failure.
        tells_json: whether a scene that fails is told on standard output too, as the results of others are.

    Raises:
        SomeFailedError: of several scenes at least one failed. Its exit code is the highest of theirs.
    """
    if not works:
        return
    if works[0].folder is not None:
        make_folder(works[0].folder)
    if len(works) == 1:
        work(works[0])
        return
    failed: list[str] = []
    code = 0
    rows: list[tuple[str, ...]] = []
    sizes = [bytes_of_scene(one.scene) or 0 for one in works]
    took, behind = 0.0, 0  # of what did not fail
    for number, one in enumerate(works):
        left = f", about {duration(took * sum(sizes[number:]) / behind)} left for all" if behind else ""
        note(f"{number + 1} of {len(works)}: {one.scene}{left}")
        began = time.perf_counter()
        try:
            row = work(one)
            seconds = time.perf_counter() - began
            took, behind = took + seconds, behind + sizes[number]
            if row is not None:
                sizes_and_ratio = megabytes(row.before), megabytes(row.after), f"{row.before / row.after:.1f} x smaller"
                rows.append((one.output.name, *sizes_and_ratio, row.psnr, duration(seconds)))
        except KeyboardInterrupt:
            note(f"{number - len(failed)} of {len(works)} scenes are done: --skip-existing goes on behind them")
            raise
        except BrokenPipeError:
            raise
        except Exception as error:
            code = max(code, error.exit_code if isinstance(error, PotrError) else 1)
            failed.append(str(one.scene))
            said = _said(error)
            rows.append((one.output.name, f"failed: {said}"))
            note(f"potr-cl: {said}" if str(one.scene) in said else f"potr-cl: '{one.scene}': {said}", "error")
            if tells_json:
                say_line({"source": {"file": str(one.scene)}, "file": str(one.output), "error": said})
    if any(len(row) > 2 for row in rows) and not tells_json:
        say_done(_table(rows))
    if failed:
        names = ", ".join(f"'{name}'" for name in failed)
        problem = SomeFailedError(f"{len(failed)} of {len(works)} scenes failed: {names}")
        problem.exit_code = code
        raise problem


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    """A line for each scene; of one that failed, its name and why."""
    name = max(len(row[0]) for row in rows)
    widths = [max(map(len, column)) for column in zip(*(row[1:] for row in rows if len(row) > 2), strict=True)]
    lines = []
    for first, *cells in rows:
        columns = cells if len(cells) == 1 else [cell.rjust(width) for cell, width in zip(cells, widths, strict=True)]
        lines.append("  ".join([first.ljust(name), *columns]))
    return "\n".join(lines)


def _said(error: Exception) -> str:
    if isinstance(error, PotrError):
        return str(error)
    if isinstance(error, MemoryError):
        return "not enough memory for this scene"
    if isinstance(error, OSError) and error.strerror:
        return plain(error.strerror)
    return plain(f"unforeseen {type(error).__name__}: {error}")


def _expanded(sources: Sequence[Path]) -> list[Path]:
    """The files that are meant, also where no shell has put names in the place of "*.ply"."""
    found: list[Path] = []
    for source in sources:
        pattern = os.fspath(source)
        if os.path.lexists(pattern) or not glob.has_magic(pattern):
            found.append(source)
        else:
            found += [ReadFile(each) for each in sorted(glob.glob(pattern, recursive=True))] or [source]
    return found


def _in_folder(args: argparse.Namespace, kind: type[WrittenFile], suffix: str | None) -> list[WrittenFile]:
    sources, output = args.scenes, args.output
    if suffix is None:
        raise UsageError(f"--to is missing: the folder '{output}' does not tell the format")
    if len(sources) > 1 and not isinstance(output, WrittenFolder) and output.suffix.lower() in registry.extensions():
        raise UsageError(f"{len(sources)} scenes need a folder, and '{output}' would be a file")
    targets: dict[str, tuple[Path, WrittenFile]] = {}
    for source, name in zip(sources, _names(sources), strict=True):
        if isinstance(source, StandardInput):
            raise UsageError(f"standard input has no name to take over into the folder '{output}': give -o a file")
        target = kind(output / (name + suffix))
        # As file systems compare that do not tell capitals from small letters.
        other = targets.setdefault(target.name.casefold(), (source, target))[0]
        if other is not source:
            raise UsageError(f"'{other}' and '{source}' would both become '{target}': write one of them elsewhere")
    files = [target for _, target in targets.values()]
    check_files(args, files)
    for file in files:
        if os.path.isdir(file):
            raise UsageError(f"cannot write '{file}': it is a directory; write the scenes elsewhere")
        check_name(file)
    return files


def _names(sources: Sequence[Path]) -> list[str]:
    """The scenes' own names; of those that share one, the folders by which they differ, as "bicycle_iteration_7000"."""
    names = [registry.stem_of_scene(source) for source in sources]
    often = Counter(name.casefold() for name in names)
    for name in [name for name, count in often.items() if count > 1]:
        alike = [k for k, other in enumerate(names) if other.casefold() == name]
        folders = [sources[k].absolute().parent.parts for k in alike]
        shared = len(Path(os.path.commonpath(sources[k].absolute().parent for k in alike)).parts)
        tails = [folder[shared:] for folder in folders]
        if len(set(map(len, tails))) == 1:
            differ = [len(set(level)) > 1 for level in zip(*tails, strict=True)]
            tails = [tuple(compress(tail, differ)) for tail in tails]
        for k, tail in zip(alike, tails, strict=True):
            # A name that all scenes have says nothing.
            names[k] = "_".join([*tail, *([names[k]] if len(often) > 1 or not tail else [])])
    return names


def _alone(args: argparse.Namespace, source: Path, target: Path, suffix: str | None) -> argparse.Namespace:
    one = copy.copy(args)
    one.scene, one.output, one.to = source, target, suffix
    one.folder = None if isinstance(target, StandardOutput) or target == args.output else target.parent
    del one.scenes
    return one
