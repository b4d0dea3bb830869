"""The formats of scenes and cameras: SCENE_FORMATS and CAMERA_FORMATS, and what people are told of them.

A format is added by one module in scenes/ or cameras/ that declares ``FORMAT``, and by its line in the table here.
Reading, writing, error messages, the help of the command line and docs/formats.md all follow the tables.
"""

from __future__ import annotations

import itertools
import os
import re
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.formats.cameras import cameras_json, colmap, transforms
from potr_cl.formats.cameras.view_files import read_json
from potr_cl.formats.declaration import CameraFormat, SceneFormat
from potr_cl.formats.ladder import ladder_at
from potr_cl.formats.scenes import compressed_ply, gltf, ksplat, page, ply, sog, sog_levels, splat, spz, tileset
from potr_cl.formats.scenes.scene_files import without_level

_GSPLAT = "export it as PLY, by gsplat's simple_trainer.py with --save-ply or by gsplat.export_splats"
_NERFSTUDIO = "export it as PLY, by nerfstudio's `ns-export gaussian-splat --load-config CONFIG.yml --output-dir DIR`"
#: How checkpoints of trainings, by their suffixes, become scenes.
_CHECKPOINTS = {".pt": _GSPLAT, ".pth": _GSPLAT, ".ckpt": _NERFSTUDIO}

#: In the order in which people are told of them.
SCENE_FORMATS: tuple[SceneFormat, ...] = (
    ply.FORMAT,
    page.POTR,
    compressed_ply.FORMAT,
    spz.FORMAT,
    sog.FORMAT,
    sog_levels.FORMAT,
    tileset.FORMAT,
    gltf.FORMAT,
    splat.FORMAT,
    ksplat.FORMAT,
    page.FORMAT,
)

#: Bytes that a scene begins with and that may be needed to tell its format.
START_BYTES = 1024
#: Where programs that train put their scenes, from the folder that they were given or from one within; and how many
#: files are looked at.
_PLACES_OF_TRAININGS = ("point_cloud/iteration_*/*", "iteration_*/*", "ply/*", "*")
_MOST_FILES = 1000
_FOLDERS_OF_TRAININGS = re.compile(r"point_cloud|iteration_\d+|ply")
_GZIP = b"\x1f\x8b"

#: In the order in which a folder is searched for them. cameras.json stands before transforms.json, for it lists just
#: the views that a scene was trained with, as they were.
CAMERA_FORMATS: tuple[CameraFormat, ...] = (colmap.FORMAT, cameras_json.FORMAT, transforms.FORMAT)


def format_of(path: Path) -> SceneFormat:
    """The format of a scene that is read. Names and extensions tell it, and the content where formats share those.

    Args:
        path: of a file, or of a folder that holds a file whose name tells the format.

    Raises:
        UsageError: no format has this name or extension.
    """
    plain = without_level(path)
    # os.path and not pathlib: what cannot be looked at, as a name that is too long, is left to the reader to refuse.
    for entry in SCENE_FORMATS:
        if any(plain.name.lower() == name or os.path.isfile(plain / name) for name in entry.names):
            return entry
    extension = path.suffix.lower()
    having_it = [entry for entry in SCENE_FORMATS if extension in entry.extensions]
    for entry in having_it:
        if entry.recognises is not None and entry.recognises(path):
            return entry
    for entry in having_it:
        if entry.recognises is None:
            return entry
    raise UsageError(_instead_of(path))


def _instead_of(path: Path) -> str:
    """What a path is that is no scene, and what to give instead."""
    extension = path.suffix.lower()
    if extension in _CHECKPOINTS:
        return f"'{path}' is a checkpoint of a training, not a scene: {_CHECKPOINTS[extension]}"
    if ladder_at(path) is not None:
        return (
            f"'{path}' is a ladder, one scene at several qualities: give one of its files, or see all of them with "
            f"potr-cl view SCENE '{path}'"
        )
    inside = _scenes_in(path) if os.path.isdir(path) else []
    if inside:
        last = max(inside, key=_iteration)
        beside = [each for each in inside if each.parent == last.parent]
        if len(beside) == 1:
            return f"'{path}' is a folder: give the scene in it, '{last}'"
        return f"'{last.parent}' holds {len(beside)} scenes: give one of them, such as '{last}', or all, *.ply"
    if _holds_cameras(path):
        return (
            f"'{path}' holds cameras, not a scene: give the scene's file, and these as --cameras to encode, render, "
            "compare or view"
        )
    names = listed([name for entry in SCENE_FORMATS for name in entry.names])
    if os.path.isdir(path):
        return f"the folder '{path}' has no scene: there is no .ply in it, and no {names}"
    return f"'{path}': unknown kind of scene, expected a {suffixes_read()} file, or a folder with {names}"


def _holds_cameras(path: Path) -> bool:
    if os.path.isdir(path):
        return any(entry.is_in(path / sub) for entry in CAMERA_FORMATS for sub in ("", *entry.subfolders))
    suffix = path.suffix.lower()
    with suppress(PotrError, OSError):
        content = read_json(path) if suffix == ".json" else None
        return any(suffix in entry.suffixes and entry.recognises(path, content) for entry in CAMERA_FORMATS)
    return False


def _scenes_in(folder: Path) -> list[Path]:
    """The scenes in a folder, also where programs that train leave them."""
    found: list[Path] = []
    for place in _PLACES_OF_TRAININGS:
        with suppress(OSError):
            found += itertools.islice(folder.glob(f"{place}.ply"), _MOST_FILES)
    return found


def _iteration(file: Path) -> tuple[int, str]:
    """By which number of a file's name and its folder's it is the last: "iteration_30000", "point_cloud_29999.ply"."""
    digits = re.findall(r"\d+", f"{file.parent.name} {file.stem}")
    return max((int(each[:18]) for each in digits), default=0), os.fspath(file)


def cameras_beside(scene: Path) -> Path | None:
    """The folder with cameras that a scene lies in, or that of the training which has left it there; None: neither."""
    folder = without_level(scene).absolute().parent
    while not any(entry.is_in(folder / sub) for entry in CAMERA_FORMATS for sub in ("", *entry.subfolders)):
        if not _FOLDERS_OF_TRAININGS.fullmatch(folder.name):
            return None
        folder = folder.parent
    return folder


def suffix_of_content(start: bytes, name: str) -> str:
    """The suffix of the format that content begins as, for a scene that comes without a name.

    Args:
        start: its first ``START_BYTES``, fewer if it is shorter.
        name: of where it comes from, for the message.

    Raises:
        DataError: no format begins like this.
    """
    packed = start.startswith(_GZIP)
    inner = _beginning_of_gzip(start) if packed else start
    for entry in SCENE_FORMATS:
        if inner.startswith(entry.starts) and entry.starts:
            suffix = entry.suffixes[0]
            return suffix if not packed or entry.gzipped else f"{suffix}.gz"
    raise DataError(
        f"the {name} begins like no scene that is known; of a format without a mark of its own, give the suffix with "
        "--from"
    )


def _beginning_of_gzip(start: bytes) -> bytes:
    """What the first bytes of a gzip file unpack to; nothing if they are damaged."""
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, 64)
    except zlib.error:
        return b""


def read_suffix(suffix: str) -> str:
    """A suffix of a format as the command line gives it, ".ply" or "ply", checked.

    Raises:
        UsageError: no format has it.
    """
    wanted = "." + suffix.lower().lstrip(".")
    if wanted.removesuffix(".gz") not in _scene_suffixes(SCENE_FORMATS):
        raise UsageError(f"'{suffix}' is no suffix of a scene: expected {suffixes_read()}")
    return wanted


def written_suffix(suffix: str) -> str:
    """The same for a format that is to be written. Raises UsageError if no format has it, or it is only read."""
    wanted = read_suffix(suffix)
    written_format(Path(f"scene{wanted}"))
    return wanted


def extensions() -> frozenset[str]:
    """The last parts of all suffixes of scenes, with the point."""
    return frozenset(extension for entry in SCENE_FORMATS for extension in entry.extensions)


def stem_of_scene(path: Path) -> str:
    """The name of a scene without the suffix of its format: "a" for "a.compressed.ply", "a.ply.gz" or "a/meta.json"."""
    plain = without_level(path)
    if any(plain.name.lower() in entry.names for entry in SCENE_FORMATS):
        return plain.absolute().parent.name
    name = plain.name[:-3] if plain.name.lower().endswith(".gz") else plain.name
    fitting = [suffix for suffix in _scene_suffixes(SCENE_FORMATS) if name.lower().endswith(suffix)]
    return name[: -len(max(fitting, key=len))] if fitting else name


def suffix_of_name(path: Path) -> str | None:
    """The longest suffix of a format that a file's name ends in, ".compressed.ply" rather than ".ply"; None: no one."""
    fitting = [suffix for suffix in _scene_suffixes(SCENE_FORMATS) if path.name.lower().endswith(suffix)]
    return max(fitting, key=len, default=None)


def written_format(path: Path) -> SceneFormat:
    """The format that the suffixes of a file to be written ask for; it has a ``save``.

    Raises:
        UsageError: no format has this suffix, or it is only read.
    """
    suffixes = "".join(path.suffixes).lower()
    fitting = [
        (len(suffix), entry) for entry in SCENE_FORMATS for suffix in entry.suffixes if suffixes.endswith(suffix)
    ]
    fitting += [(len(path.name), entry) for entry in SCENE_FORMATS if path.name.lower() in entry.names]
    expected = f"give it one of {suffixes_written()}"
    if not fitting:
        raise UsageError(f"'{path}' {unwritten(path)}: {expected}")
    _, entry = max(fitting, key=lambda found: found[0])
    if entry.save is None:
        raise UsageError(f"'{path}': {entry.not_written}; {expected}")
    return entry


def unwritten(path: Path) -> str:
    """For messages: what is wrong with the name of a file to be written, whose format is unknown."""
    return f"ends in '{path.suffix}', which cannot be written" if path.suffix else "has no suffix to tell the format"


def suffixes_read() -> str:
    """For messages and help: the suffixes of all scenes that are read, ".a, .b or .c"."""
    return listed(_scene_suffixes(SCENE_FORMATS))


def suffixes_written() -> str:
    """For messages and help: the suffixes of all scenes that are written, ".a, .b or .c"."""
    return listed(_scene_suffixes(entry for entry in SCENE_FORMATS if entry.save is not None))


def cameras_read() -> str:
    """For messages and help: the kinds of cameras that are read, "a x, a y or a z"."""
    return listed([f"a {entry.name}" for entry in CAMERA_FORMATS])


def json_cameras() -> str:
    """For messages: the kinds of cameras in .json files, with what marks each, "a x (…) nor a y (…)"."""
    return listed([f"a {entry.name} ({entry.json_mark})" for entry in CAMERA_FORMATS if entry.json_mark], "nor")


def listed(items: Sequence[str], word: str = "or") -> str:
    """Items as an English list: "a", "a or b", "a, b or c"."""
    return f" {word} ".join([", ".join(items[:-1]), items[-1]]) if len(items) > 1 else "".join(items)


def _scene_suffixes(formats: Iterable[SceneFormat]) -> list[str]:
    return [suffix for entry in formats for suffix in entry.suffixes]


def bytes_of_scene(path: str | os.PathLike[str]) -> int | None:
    """Bytes of a scene: of its file, or of all files that belong to it, whatever level of detail is read.

    Args:
        path: as :func:`potr_cl.formats.load_scene` takes it.

    Returns:
        The number, of the files that there are; None where there is no such scene, or no reader would know its files.
    """
    given = without_level(path)
    try:
        if not given.exists():
            return None
        return sum(file.stat().st_size for file in _files(given) if file.is_file()) or None
    except (OSError, ValueError, PotrError):
        return None


def _files(path: Path) -> list[Path]:
    try:
        files = format_of(path).files
    except UsageError:  # of a .potr file by another name, its own
        files = None
    return [path] if files is None else files(path)
