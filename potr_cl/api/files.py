"""Files of scenes: :func:`save`, :func:`convert`, :func:`decode` and :func:`decode_to_device`.

To decode takes less time than to import what other functions need, so little is imported here.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from potr_cl.api.inputs import (
    DeviceSource,
    SceneSource,
    device_of,
    encoded_bytes,
    encoded_file,
    on_device,
    scene_of,
)
from potr_cl.codec.decoder import decode as decode_file
from potr_cl.codec.decoder import open_file
from potr_cl.codec.levels import level_within, splats_of_levels
from potr_cl.errors import DataError, UsageError
from potr_cl.host.atomic_write import check_place, replacing
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene

if TYPE_CHECKING:
    from potr_cl.pipeline.encoded import Encoded
    from potr_cl.raster.scene_buffers import SceneBuffers


def save(scene: SceneSource, path: str | os.PathLike[str]) -> None:
    """Write a scene in the format that the suffixes of ``path`` tell; the file appears only when it is whole.

    Args:
        scene: to write. The result of :func:`potr_cl.encode` is written as it is to a file of its own kind, and decoded
            for any other format.
        path: of the file.

    Raises:
        UsageError: no format that is written has these suffixes, ``path`` cannot be written to, or an extra is missing.
        PotrError: the format cannot hold the scene, or the system failed to write.
    """
    from potr_cl.formats import scene_writer
    from potr_cl.formats.registry import suffix_of_name

    encoded = encoded_file(scene)
    if encoded is not None and suffix_of_name(Path(path)) == encoded[0]:
        with replacing(path) as file:
            file.write(encoded[1])
        return
    write = scene_writer(path)  # a wrong name is reported before anything is read
    write(scene_of(scene))


def result_writer(output: str | os.PathLike[str] | None) -> Callable[[Scene], None] | None:
    """What writes a scene that takes long to make.

    Args:
        output: the file; None: nothing is to be written.

    Returns:
        Takes the scene, and raises as :func:`potr_cl.formats.save_scene`; None if there is nothing to write.

    Raises:
        UsageError: no scene can be written to a file of this name, or no file there.
    """
    if output is None:
        return None
    from potr_cl.formats import scene_writer

    write = scene_writer(output)  # a wrong name is reported before anything is made
    check_place(output)
    return write


def convert(
    scene: SceneSource,
    output: str | os.PathLike[str],
    *,
    spz_version: int | None = None,
    title: str | None = None,
    author: str | None = None,
    trust: bool = False,
    antialiased: bool | None = None,
) -> Scene:
    """Read a scene and write it in another format, as the command ``convert`` does.

    Args:
        scene: its file, usually.
        output: the file to write; its suffixes tell the format.
        spz_version: of an .spz file, 2, 3 or 4; by default the one that all readers that were tried take.
        title, author: shown on a page (.html). A .potr file goes into it as it is.
        trust, antialiased: as of :func:`potr_cl.load_scene`.

    Returns:
        The scene, as it was read.

    Raises:
        UsageError, DataError: as :func:`potr_cl.load_scene` and :func:`save`.
    """
    from potr_cl.formats import scene_writer

    source = Path(scene) if isinstance(scene, (str, os.PathLike)) and antialiased is None else None
    write = scene_writer(output, version=spz_version, title=title, author=author, source=source)
    read = scene_of(scene, trust, antialiased)
    write(read)
    return read


def decode(
    file: str | os.PathLike[str] | bytes | Encoded,
    trust: bool = False,
    sh_degree: int | None = None,
    *,
    box: Sequence[float] | None = None,
    level: int | None = None,
    splats: int | None = None,
    output: str | os.PathLike[str] | None = None,
) -> Scene:
    """Decode a .potr file, as the command ``decode`` does.

    Args:
        file: its path, its bytes, or the result of :func:`potr_cl.encode`.
        trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.
        sh_degree: leave out SH coefficients of higher degrees, without decoding them; None: none.
        box: x0, y0, z0, x1, y1, z1 in world units: leave out splats whose centres lie outside. Of a file of blocks only
            those that meet the box are read.
        level: of detail; the finest, 0, by default.
        splats: take the finest level that has no more splats than this, in place of ``level``.
        output: a file to write the scene to as well, usually a .ply.

    Raises:
        UsageError: the path cannot be read, ``output`` not be written to, there is no such degree or level, no level
            has so few splats, or no splat lies in the box.
        DataError: not a .potr file, a damaged one, or too many splats for its size.
    """
    write = None
    if output is not None:
        from potr_cl.formats import scene_writer

        write = scene_writer(output)
    data = encoded_bytes(file)
    if data is None and not isinstance(file, (str, os.PathLike)):
        raise UsageError(f"expected the path of a .potr file, its bytes or an Encoded, not {type(file).__name__}")
    within = None if box is None else Box.of(box)
    source: str | os.PathLike[str] | bytes = file if data is None else data  # type: ignore[assignment]
    level = chosen_level(source, level, splats, trust)
    scene = decode_file(source, trust, sh_degree, within, level)
    if write is not None:
        write(scene)
    return scene


def chosen_level(
    file: str | os.PathLike[str] | bytes, level: int | None, splats: int | None, trust: bool = False
) -> int:
    """The level of detail that is asked for by its number or by how many splats it may have; the finest by default.

    Raises:
        UsageError: both are given, or no level has so few splats.
        DataError: as :func:`decode`.
    """
    if splats is None:
        return level or 0
    if level is not None:
        raise UsageError("give a level of detail or a number of splats, not both")
    return level_within(open_file(file, trust), splats)


def decode_block_by_block(
    file: str | os.PathLike[str],
    output: str | os.PathLike[str],
    trust: bool = False,
    sh_degree: int | None = None,
    level: int | None = None,
    splats: int | None = None,
) -> int | None:
    """Decode a .potr file of blocks into a .ply, with no more of its blocks in memory than are decoded side by side.

    Args:
        file: its path.
        output: the file to write.
        trust, sh_degree, level, splats: as of :func:`decode`.

    Returns:
        The number of splats; None if the file is not one of blocks or the output no .ply: nothing was done then.

    Raises:
        As :func:`decode`.
    """
    from potr_cl.formats.registry import suffix_of_name
    from potr_cl.formats.scenes import ply

    if suffix_of_name(Path(output)) != ".ply":
        return None
    opened = open_file(file, trust)
    if len(opened.blocks) == 1:
        return None
    chosen = chosen_level(file, level, splats, trust)
    parts = opened.parts(sh_degree=sh_degree, level=chosen)
    count = splats_of_levels(opened)[chosen] if chosen < opened.levels else 0  # then parts say what is wrong
    try:
        ply.save_parts(output, parts, count)
    except DataError as error:
        raise DataError(f"'{os.fspath(file)}': {error}") from None
    return count


def decode_to_device(
    file: str | os.PathLike[str] | bytes | Encoded,
    device: DeviceSource = None,
    *,
    trust: bool = False,
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
) -> SceneBuffers:
    """Decode a .potr file into the memory of an OpenCL device, for a renderer that runs there.

    The host makes values of the file's integers while they are in a cache, and uploads those that are not 0, in the
    layout and with the bits that :class:`potr_cl.raster.rasterizer.Rasterizer` has after it has uploaded the scene that
    :func:`decode` makes.

    Args:
        file: its path, its bytes, or the result of :func:`potr_cl.encode`.
        device: to hold the scene, or what it is called; the one that should be fastest by default.
        trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.
        sh_degree: leave out SH coefficients of higher degrees, without decoding them; None: none.
        antialiased: whether to take it as an antialiased scene; None: as the file says.
        threads: for the host's part; 0: one a processor.

    Returns:
        The scene, finished; give its memory back with ``close`` or by ``with``.

    Raises:
        UsageError: the path cannot be read, or there is no such degree.
        DataError: not a .potr file, a damaged one, or too many splats for its size.
        DeviceError: the scene does not fit the device, or the device failed.
    """
    return on_device(file, device_of(device), trust, sh_degree, antialiased, threads)
