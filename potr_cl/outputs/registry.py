"""The table of outputs, :data:`OUTPUTS`, and the output that a name asks for."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from potr_cl.errors import UsageError
from potr_cl.formats.registry import listed, stem_of_scene, suffix_of_name, unwritten, written_format
from potr_cl.outputs.output import Output
from potr_cl.outputs.ply import CompressedPly, Ply
from potr_cl.outputs.potr import Page, Potr
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.spz import Gltf, Spz
from potr_cl.outputs.streamed_sog import StreamedSog
from potr_cl.outputs.tiles import Tiles

#: In the order in which people are told of them; the first is the usual one.
OUTPUTS: tuple[type[Output], ...] = (
    Potr,
    Spz,
    Sog,
    CompressedPly,
    Gltf,
    Ply,
    Page,
)


#: Those that are folders, which the name of the description asks for.
FOLDERS: tuple[type[Output], ...] = (StreamedSog, Tiles)


def output_of(path: Path, **choices: Any) -> Output:
    """The output that a file's suffixes ask for: the longest that fits.

    Args:
        path: of the file to be written; it need not exist.
        choices: fields of the output; None means its default.

    Raises:
        UsageError: encode does not write such files, or the output has no such choice.
    """
    suffix = suffix_of_name(path)
    kind = next((kind for kind in OUTPUTS if suffix in kind.suffixes()), None)
    kind = next((folder for folder in FOLDERS if path.name in folder.suffixes()), kind)
    if kind is None:
        raise UsageError(_instead(path))
    given = {name: value for name, value in choices.items() if value is not None}
    for name in given:
        if name not in kind.__dataclass_fields__:
            raise UsageError(f"'{path}': {kind.format.name} has no {name} to choose")
    return kind(**given)


def output_of_suffix(suffix: str, **choices: Any) -> Output:
    """The same for a suffix as the command line gives it, ".spz" or "spz".

    Raises:
        UsageError: encode does not write such files.
    """
    return output_of(Path(f"scene.{suffix.lstrip('.')}"), **choices)


def encoded_suffix(suffix: str) -> str:
    """A suffix of an output as the command line gives it, checked.

    Raises:
        UsageError: encode does not write such files.
    """
    wanted = "." + suffix.lower().lstrip(".")
    if not any(wanted in kind.suffixes() for kind in OUTPUTS):
        raise UsageError(f"'{wanted}' is no suffix of what encode writes: expected {suffixes_encoded()}")
    return wanted


def suffixes_encoded() -> str:
    """For messages and help: the suffixes of all outputs, ".a, .b or .c"."""
    return listed([suffix for kind in (*OUTPUTS, *FOLDERS) for suffix in kind.suffixes()])


def _instead(path: Path) -> str:
    """What to do where encode does not write files of a name."""
    with contextlib.suppress(UsageError):
        written_format(path)
        name = path.with_name(f"{stem_of_scene(path)}.potr")
        return f"encode does not write '{path}': encode to '{name}', then 'potr-cl decode {name} -o {path}'"
    return f"'{path}' {unwritten(path)}: give it one of {suffixes_encoded()}"
