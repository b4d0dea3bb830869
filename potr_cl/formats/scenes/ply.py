"""Scenes as PLY files: every layout in use is read, the original one (Kerbl et al. 2023) is written."""

from __future__ import annotations

import collections
import io
import itertools
import logging
import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyListProperty

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.ply_antialiasing import ANTIALIASED_COMMENT, FILTER_3D, folded, marked
from potr_cl.formats.scenes.ply_rows import Target, read_rows
from potr_cl.formats.scenes.scene_files import NO_EXTENT, cleaned
from potr_cl.host.atomic_write import write_pieces
from potr_cl.host.inputs import unchanged
from potr_cl.model.scene import MIP_SPLATTING_LOW_PASS, SH_COEFFICIENTS, Scene

_log = logging.getLogger("potr_cl")

# Rows that stay in the cache of a core while their columns are gathered or scattered.
_BLOCK_BYTES = 1 << 20
_MAX_HEADER_BYTES = 1 << 20
_NORMALS = ("nx", "ny", "nz")
#: Properties f_rest_* of degree 3, and of degree 4, of which those of degree 3 are read.
_MOST_REST, _REST_OF_DEGREE_4 = 45, 72


@dataclass(frozen=True)
class _Header:
    """What stands before the values of a PLY file.

    Attributes:
        text: whether the values are ASCII.
        byte_order: "<" or ">"; of no meaning for text.
        elements: with their number of rows, in file order.
        size: bytes up to the first value.
        comments: without the word "comment".
    """

    text: bool
    byte_order: str
    elements: list[tuple[PlyElement, int]]
    size: int
    comments: list[str]


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """A trained scene from a PLY file; see :class:`potr_cl.formats.declaration.SceneLoader`.

    Accepted are binary files of either byte order and ASCII ones, properties in any order and of any numeric type,
    with or without normals, SH degree 0 to 3 with ``f_rest_*`` channel after channel; of degree 4, the coefficients of
    degree 4 are dropped. Splats with two scales (2DGS) are flat along their third axis. Comments tell whether the scene
    is antialiased, or the property ``filter_3D``, which is folded into scales and opacities
    (:mod:`potr_cl.formats.scenes.ply_antialiasing`). Further properties and elements are dropped. What
    had to be dropped or mended is reported once to the logger "potr_cl". Every array of the scene is contiguous.
    """
    try:
        # Unbuffered: the blocks are as large as a buffer should be.
        stream = open(path, "rb", buffering=0)  # noqa: SIM115
    except IsADirectoryError as error:
        raise UsageError(f"'{path}' is a directory, not a PLY file") from error
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot open '{path}': {getattr(error, 'strerror', None) or error}") from error
    with stream:
        status = os.fstat(stream.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise UsageError(f"'{path}' is not a regular file")
        try:
            with unchanged(path, stream):
                scene = _read(path, stream, status.st_size)
        except OSError as error:
            raise DataError(f"cannot read '{path}': {error.strerror or error}") from error
    return cleaned(path, scene)


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene in the original layout, which every viewer opens.

    Binary little-endian float32: x y z, nx ny nz (zero), f_dc_*, f_rest_* (all red, all green, all blue), opacity,
    scale_*, rot_*. The header of an antialiased scene says so in a comment, as Brush's does; one with Mip-Splatting's
    low-pass filter also has the property filter_3D, which is 0, as nothing is left to be folded in. See
    :class:`potr_cl.formats.declaration.SceneSaver`.
    """
    write_pieces(path, pieces(scene))


def pieces(scene: Scene) -> Iterator[bytes | memoryview]:
    """The bytes of :func:`save`, to be written one after another; each is good until the next is asked for."""
    return pieces_of_parts([scene], len(scene))


def save_parts(path: str | os.PathLike[str], parts: Iterable[Scene], splats: int) -> None:
    """Write a scene that comes in parts, which need not be in memory together, as :func:`save` writes a whole one.

    Args:
        path: of the file to write.
        parts: at least one, of the same SH degree and filter.
        splats: of all parts together.

    Raises:
        As :func:`save`.
        DataError: the parts do not belong together, or hold another number of splats.
    """
    write_pieces(path, pieces_of_parts(parts, splats))


def pieces_of_parts(parts: Iterable[Scene], splats: int) -> Iterator[bytes | memoryview]:
    """The bytes of :func:`save_parts`, as those of :func:`pieces`. Raises DataError if as :func:`save_parts`."""
    kind: tuple[int, bool, float] | None = None
    left = splats
    for part in parts:
        its_kind = part.sh_degree, part.antialiased, part.low_pass
        if kind is None:
            kind = its_kind
            names = _written_names(part)
            yield _written_header(part, names, splats)
        left -= len(part)
        if its_kind != kind or left < 0:
            raise DataError(f"the parts of the scene do not belong together, or hold more than {splats} splats")
        yield from _rows(part, names)
    if left:
        raise DataError(f"the parts of the scene lack {left} of {splats} splats")


def _written_names(scene: Scene) -> list[str]:
    names = ["x", "y", "z", *_NORMALS, *_property_names((scene.sh.shape[1] - 1) * 3)[3:]]
    return [*names, FILTER_3D] if scene.low_pass == MIP_SPLATTING_LOW_PASS else names


def _written_header(scene: Scene, names: list[str], splats: int) -> bytes:
    header = ["ply", "format binary_little_endian 1.0"]
    if scene.antialiased:
        header.append(f"comment {ANTIALIASED_COMMENT}")
    header.append(f"element vertex {splats}")
    header += [f"property float {name}" for name in names]
    return "\n".join([*header, "end_header", ""]).encode("ascii")


def _rows(scene: Scene, names: list[str]) -> Iterator[memoryview]:
    rest = scene.sh.shape[1] - 1
    end = len(names) - (names[-1] == FILTER_3D)
    height = _BLOCK_BYTES // (4 * len(names))
    rows = np.zeros((min(height, len(scene)), len(names)), dtype="<f4")
    for start in range(0, len(scene), height):
        span = slice(start, min(start + height, len(scene)))
        block = rows[: span.stop - start]
        block[:, 0:3] = scene.means[span]
        block[:, 6:9] = scene.sh[span, 0]
        for channel in range(3):
            block[:, 9 + channel * rest : 9 + (channel + 1) * rest] = scene.sh[span, 1:, channel]
        block[:, end - 8] = scene.opacity_logits[span]
        block[:, end - 7 : end - 4] = scene.log_scales[span]
        block[:, end - 4 : end] = scene.quaternions[span]
        yield block.data.cast("B")


FORMAT = SceneFormat(
    name="3DGS PLY",
    suffixes=(".ply",),
    note="as the original implementation, gsplat, nerfstudio, Postshot, Brush and SuperSplat write it: SH degree 0 to "
    "3 (of 4, what 3 has), binary or ASCII, properties in any order, 2DGS too; the original layout is written",
    load=load,
    save=save,
    starts=(b"ply\n", b"ply\r"),
)


def _property_names(rest: int, scales: int = 3) -> list[str]:
    """The properties that hold a splat with ``rest`` AC coefficients, in the original order, without normals."""
    return [
        *("x", "y", "z"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(scales)),
        *(f"rot_{i}" for i in range(4)),
    ]


def _read(path: str | os.PathLike[str], stream: io.FileIO, size: int) -> Scene:
    header = _read_header(path, stream)
    vertex, count = _vertex_element(path, header)
    rest, scales = _check_properties(path, header, vertex)
    offset = _check_size(path, header, size)
    if count == 0:
        raise DataError(f"'{path}' has no splats")
    _report_dropped(path, header, vertex, rest)
    kept = min(rest, _MOST_REST)
    if rest > kept:
        _log.warning("'%s': SH degree 4 is left out: only degrees 0 to 3 are kept", path)
    if scales < 3:
        _log.warning("'%s' has two scales a splat (2DGS): the third is read as 1e-9 unit, along the third axis", path)

    scene = Scene.blank(count, 1 + kept // 3, by_splat=True)
    targets = _targets(scene, rest // 3, scales)
    if scales < 3:
        scene.log_scales[:, 2] = NO_EXTENT
    filters = np.empty(count, dtype=np.float32) if FILTER_3D in {p.name for p in vertex.properties} else None
    if filters is not None:
        targets.append(Target(filters[:, None], (FILTER_3D,)))
    if header.text:
        stream.seek(offset)
        start = 0
        with np.errstate(over="ignore"):
            for block in _text_blocks(path, stream, header, vertex, count):
                for target in targets:
                    target.fill(start, block)
                start += len(block)
    else:
        read_rows(path, stream, offset, vertex.dtype(header.byte_order), count, targets)
    if filters is not None:
        return folded(scene, filters)
    return marked(scene, header.comments)


def _targets(scene: Scene, rest: int, scales: int) -> list[Target]:
    """Where in the scene's arrays properties belong. A channel has ``rest`` AC coefficients, a splat 2 or 3 scales."""
    own = range(scene.sh.shape[1] - 1)
    sh = [f"f_dc_{channel}" for channel in range(3)]
    sh += [f"f_rest_{channel * rest + i}" for i in own for channel in range(3)]
    return [
        Target(scene.means, ("x", "y", "z")),
        Target(scene.sh.reshape(len(scene), -1), tuple(sh)),
        Target(scene.opacity_logits[:, None], ("opacity",)),
        Target(scene.log_scales[:, :scales], tuple(f"scale_{i}" for i in range(scales))),
        Target(scene.quaternions, tuple(f"rot_{i}" for i in range(4))),
    ]


def _read_header(path: str | os.PathLike[str], stream: io.FileIO) -> _Header:
    """Parse the header alone: nothing is believed about the values yet."""
    head = stream.read(_MAX_HEADER_BYTES)
    if not head:
        raise DataError(f"'{path}' is empty")
    newline = next((n for n in (b"\r\n", b"\n", b"\r") if head.startswith(b"ply" + n)), None)
    if newline is None:
        raise DataError(f"'{path}' is not a PLY file: it does not start with the line 'ply'")
    lines: list[bytes] = []
    comments: list[str] = []
    counts = []
    position = 0
    while not (lines and lines[-1] == b"end_header"):
        end = head.find(newline, position)
        if end < 0:
            raise DataError(f"'{path}' is damaged: its PLY header does not end")
        line = head[position:end].strip()
        position = end + len(newline)
        fields = line.split()
        if fields[:1] in ([b"comment"], [b"obj_info"]):
            comments.append(line.partition(fields[0])[2].decode("latin-1"))  # may be in any encoding
            continue
        if fields[:1] == [b"element"] and len(fields) == 3:
            counts.append(_count(path, fields[2]))
            line = b"element %s 0" % fields[1]
        lines.append(line)
    # With counts of zero the library parses the header and has no values to read.
    try:
        ply = PlyData.read(io.BytesIO(b"\n".join([*lines, b""])))
        return _Header(ply.text, ply.byte_order, list(zip(ply.elements, counts, strict=True)), position, comments)
    except Exception as error:  # the library raises what its parts happen to raise
        raise DataError(f"'{path}' has a damaged PLY header: {_one_line(error)}") from error


def _count(path: str | os.PathLike[str], digits: bytes) -> int:
    if not digits.isdigit() or len(digits) > 18:
        raise DataError(f"'{path}' has a damaged PLY header: {digits[:40]!r} is not a number of elements")
    return int(digits)


def _vertex_element(path: str | os.PathLike[str], header: _Header) -> tuple[PlyElement, int]:
    for element, count in header.elements:
        if element.name == "vertex":
            return element, count
    found = ", ".join(element.name for element, _ in header.elements) or "none"
    raise DataError(f"'{path}' is no 3DGS scene: it has no element 'vertex' (its elements: {_shortened(found)})")


def _check_properties(path: str | os.PathLike[str], header: _Header, vertex: PlyElement) -> tuple[int, int]:
    """Check that the properties of a splat are all there; return the numbers of f_rest_* and scale_* among them."""
    names = {p.name for p in vertex.properties}
    if "packed_position" in names:
        raise DataError(
            f"'{path}' is a compressed PLY of SuperSplat: export it from SuperSplat as uncompressed PLY, "
            "or run 'splat-transform IN.compressed.ply OUT.ply'"
        )
    rest = sum(str(name).startswith("f_rest_") for name in names)
    accepted = [*(3 * (m - 1) for m in SH_COEFFICIENTS), _REST_OF_DEGREE_4]
    scales = 3 if "scale_2" in names or "scale_1" not in names else 2
    missing = [name for name in _property_names(rest, scales) if name not in names]
    if missing:
        message = f"'{path}' is no 3DGS scene: its vertices lack the properties {_shortened(', '.join(missing))}"
        if "opacity" in names and {"red", "green", "blue"} <= names:
            message += "; it stores RGB colours: export it with SH (nerfstudio: --ply-color-mode sh_coeffs)"
        elif "opacity" not in names:
            message += "; this is a mesh or a point cloud"
        raise DataError(message)
    if rest not in accepted:
        raise DataError(f"'{path}': {rest} f_rest properties, expected one of {accepted}")
    before = itertools.takewhile(lambda entry: entry[0] is not vertex, header.elements)
    if any(isinstance(p, PlyListProperty) for element in (vertex, *(e for e, _ in before)) for p in element.properties):
        raise DataError(f"'{path}': list properties in or before the element 'vertex' are not supported")
    return rest, scales


def _check_size(path: str | os.PathLike[str], header: _Header, size: int) -> int:
    """Check the header's counts against the file's size, before any memory is taken on their word.

    Returns:
        Where the values of the vertices start (for text: where the values of all elements start).
    """
    offset = end = header.size
    for element, count in header.elements:
        if header.text:
            end += count * max(1, 2 * len(element.properties))  # a digit and a separator each
            slack = 1  # the last line may lack its end
        else:
            if element.name == "vertex":
                offset = end
            end += count * sum(
                np.dtype(p.len_dtype if isinstance(p, PlyListProperty) else p.val_dtype).itemsize
                for p in element.properties
            )
            slack = 0
        if end > size + slack:
            raise DataError(
                f"'{path}' is truncated: its header announces {count} of element '{element.name}', "
                f"which takes a file of {end - slack} bytes or more, and it has {size}"
            )
    return offset


def _report_dropped(path: str | os.PathLike[str], header: _Header, vertex: PlyElement, rest: int) -> None:
    known = {*_property_names(rest), *_NORMALS, FILTER_3D}
    extra = [p.name for p in vertex.properties if p.name not in known]
    if extra:
        _log.warning("'%s': dropped %d unknown properties: %s", path, len(extra), _shortened(", ".join(extra)))
    others = [element.name for element, _ in header.elements if element.name != "vertex"]
    if others:
        _log.warning("'%s': dropped %d unknown elements: %s", path, len(others), _shortened(", ".join(others)))


def _text_blocks(
    path: str | os.PathLike[str], stream: io.FileIO, header: _Header, vertex: PlyElement, count: int
) -> Iterator[NDArray[np.void]]:
    """The rows of the vertices of an ASCII file, a block at a time; earlier elements are skipped line by line."""
    # Every byte has a meaning in Latin-1, so a stray one is found where it stands, as a value that is no number.
    with io.TextIOWrapper(io.BufferedReader(stream), encoding="latin-1") as text:
        lines = (line for line in text if not line.isspace())
        for element, rows in header.elements:
            if element.name == "vertex":
                break
            collections.deque(itertools.islice(lines, rows), maxlen=0)
        dtype = np.dtype([(p.name, np.float32) for p in vertex.properties])
        height = max(1, _BLOCK_BYTES // dtype.itemsize)
        for start in range(0, count, height):
            wanted = min(height, count - start)
            block = list(itertools.islice(lines, wanted))
            if len(block) < wanted:
                raise DataError(f"'{path}' is truncated: it ends before splat {start + len(block)}")
            try:
                yield np.loadtxt(block, dtype=dtype, comments=None, ndmin=1)
            except ValueError as error:
                raise DataError(f"'{path}': splats {start} to {start + wanted - 1}: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return _shortened(" ".join(str(error).split())) or type(error).__name__


def _shortened(text: str) -> str:
    return text if len(text) <= 200 else text[:197] + "..."
