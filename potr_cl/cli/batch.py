"""One scene or several in one call (:func:`for_each_scene`): where each goes, and what happens if one of them fails."""

from __future__ import annotations

import argparse
import copy
import glob
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from potr_cl.cli.guard import ReadFile, StandardInput, StandardOutput, WrittenFile, WrittenFolder, check_files
from potr_cl.cli.outputs import check_file, check_name, suffix_of
from potr_cl.cli.scenes import TO_HELP
from potr_cl.cli.terminal import note, say_line
from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import registry
from potr_cl.plain_text import plain

#: What is done with each scene: it gets the command's arguments with ``scene`` and ``output`` of one scene alone.
Work = Callable[[argparse.Namespace], None]


class SomeFailedError(PotrError):
    """Some scenes of several failed; each of them has been told already."""


def add_to_option(p: argparse._ActionsContainer) -> None:
    """``--to``, for every command that may write scenes where their names do not tell the format."""
    p.add_argument("--to", metavar="SUFFIX", help=TO_HELP)


def jobs(args: argparse.Namespace, kind: type[WrittenFile], suffix: str | None) -> list[argparse.Namespace]:
    """The command's arguments for each scene alone, all outputs checked.

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
            raise UsageError(f"'{output}' tells its format itself: --to is for folders and standard output")
        targets = [kind(output)]
        check_file(kind(output))
    if isinstance(output, StandardOutput) and wanted is None:
        raise UsageError("--to is missing: standard output has no name that tells the format")
    return [_alone(args, source, target, wanted) for source, target in zip(sources, targets, strict=True)]


def for_each_scene(works: Sequence[argparse.Namespace], work: Work, tells_json: bool = False) -> None:
    """Do the same with each scene; if one of several fails, say why in one line and go on with the next.

    Args:
        works: of :func:`jobs`.
        work: what is done; of a single scene whatever it raises is the command's own failure.
        tells_json: whether a scene that fails is told on standard output too, as the results of others are.

    Raises:
        SomeFailedError: of several scenes at least one failed. Its exit code is the highest of theirs.
    """
    if works[0].folder is not None:
        _make_folder(works[0].folder)
    if len(works) == 1:
        work(works[0])
        return
    failed: list[str] = []
    code = 0
    for one in works:
        try:
            work(one)
        except BrokenPipeError:
            raise
        except Exception as error:
            code = max(code, error.exit_code if isinstance(error, PotrError) else 1)
            failed.append(str(one.scene))
            said = _said(error)
            note(f"potr-cl: {said}" if str(one.scene) in said else f"potr-cl: '{one.scene}': {said}", "error")
            if tells_json:
                say_line({"source": {"file": str(one.scene)}, "file": str(one.output), "error": said})
    if failed:
        names = ", ".join(f"'{name}'" for name in failed)
        problem = SomeFailedError(f"{len(failed)} of {len(works)} scenes failed: {names}")
        problem.exit_code = code
        raise problem


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
        several = [] if os.path.lexists(pattern) or not glob.has_magic(pattern) else sorted(glob.glob(pattern))
        found += [ReadFile(each) for each in several] or [source]
    return found


def _in_folder(args: argparse.Namespace, kind: type[WrittenFile], suffix: str | None) -> list[WrittenFile]:
    sources, output = args.scenes, args.output
    if suffix is None:
        raise UsageError(f"--to is missing: the folder '{output}' does not tell the format")
    if len(sources) > 1 and not isinstance(output, WrittenFolder) and output.suffix.lower() in registry.extensions():
        raise UsageError(f"{len(sources)} scenes need a folder, and '{output}' would be a file")
    targets: dict[str, tuple[Path, WrittenFile]] = {}
    for source in sources:
        if isinstance(source, StandardInput):
            raise UsageError(f"standard input has no name to take over into the folder '{output}': give -o a file")
        target = kind(output / (registry.stem_of_scene(source) + suffix))
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


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{folder}': {error.strerror}") from None


def _alone(args: argparse.Namespace, source: Path, target: Path, suffix: str | None) -> argparse.Namespace:
    one = copy.copy(args)
    one.scene, one.output, one.to = source, target, suffix
    one.folder = None if isinstance(target, StandardOutput) or target == args.output else target.parent
    del one.scenes
    return one
