"""Pictures in files: ground truth to compare with, PNG files to look at, and names of background colours."""

from __future__ import annotations

import contextlib
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.host.inputs import refuse_lfs_pointer
from potr_cl.host.libraries import without_warnings
from potr_cl.model.scene import FloatArray

# Pillow takes a tenth of the time that a command needs to begin, and few commands see a picture.
if TYPE_CHECKING:
    from PIL import Image

Colour = tuple[float, float, float]

#: What photographs are read from. Pillow knows dozens of formats more, some of which start other programs.
_FORMATS = ("PNG", "JPEG", "WEBP")
#: Photographs with more pixels would take gigabytes each, however small their files are.
_MOST_PIXELS = 1 << 27
#: Colours that are known without Pillow.
_COMMON: dict[str, Colour] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
#: More than 8 bits in one channel: Pillow would clip them on the way to R, G, B.
_DEEP_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
#: Numbers that are rounded to 8 bits at a time.
_SLICE = 1 << 20


def parse_colour(text: str) -> Colour:
    """A colour from ``R,G,B`` (0 to 1 each), a name ("white") or hexadecimal digits ("#fff", "#20a0ff").

    Raises:
        UsageError: it is none of these.
    """
    with contextlib.suppress(ValueError):
        values = [float(value) for value in text.split(",")]
        if len(values) == 3 and all(0 <= value <= 1 for value in values):
            return values[0], values[1], values[2]
    if text.strip().lower() in _COMMON:
        return _COMMON[text.strip().lower()]
    from PIL import ImageColor

    with contextlib.suppress(ValueError):
        red, green, blue = ImageColor.getrgb(text.strip())[:3]
        return red / 255, green / 255, blue / 255
    raise UsageError(f"unknown colour '{text}': give R,G,B from 0 to 1, a name such as white, or #rrggbb")


def opened_image(source: Any, formats: tuple[str, ...]) -> Image.Image:
    """An image of one of some formats (Pillow's names), of which no more than the header is read yet.

    Args:
        source: a path or an open file.
        formats: no other one is even looked at.

    Raises:
        UnidentifiedImageError: it is of no such format.
        ValueError: it has several frames.
    """
    from PIL import Image

    with without_warnings():  # a size that Pillow would warn of is checked by whoever calls this
        image = Image.open(source, formats=formats)
    if image.format == "WEBP" and getattr(image, "n_frames", 1) != 1:
        image.close()
        raise ValueError("it is animated")
    return image


class _File(io.BufferedReader):
    """A file in which nothing is read beyond its end: Pillow asks for as many bytes as a file says of its parts, and
    Python makes room for all that it is asked for."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


@contextlib.contextmanager
def _opened_photograph(path: Path) -> Iterator[Image.Image]:
    """A photograph whose pixels fit the memory; Pillow's many errors for a bad file become ours."""
    from PIL import UnidentifiedImageError

    try:
        # Before it is opened: a pipe would be waited for.
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise UsageError(f"cannot read '{path}': it is not a regular file")
        # Pillow tells of parts that it leaves out: no colour depends on them.
        with _File(path) as file, without_warnings(), opened_image(file, _FORMATS) as image:
            width, height = image.size
            if width * height > _MOST_PIXELS:
                raise DataError(f"'{path}' has {width} x {height} pixels, at most {_MOST_PIXELS} are read")
            yield image
    except PotrError:
        raise
    except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise UsageError(f"cannot read '{path}': {error.strerror}") from None
    except UnidentifiedImageError:
        refuse_lfs_pointer(path)
        raise DataError(
            f"'{path}' is damaged or of another kind: it is no PNG, JPEG or WebP image that can be read"
        ) from None
    except MemoryError:
        raise
    except Exception as error:  # each of Pillow's decoders has errors of its own
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"'{path}' is damaged or of another kind: {reason}") from None


def _refuse_deep(path: Path, image: Image.Image) -> None:
    if image.mode in _DEEP_MODES:
        raise DataError(f"'{path}' has more than 8 bits a channel: convert it to an 8-bit image")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, from its header alone.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is no PNG, JPEG or WebP image, or has too many pixels.
    """
    with _opened_photograph(path) as image:
        return image.size


def read_ground_truth(path: Path, background: Colour = (0.0, 0.0, 0.0)) -> FloatArray:
    """Read an image with 8 bits a channel.

    Args:
        path: of the file.
        background: colour behind an image with (straight) alpha, 0 to 1.

    Returns:
        (H, W, 3) float32, 0 to 1, as stored: neither turned by an orientation tag nor linearised.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is no PNG, JPEG or WebP image, is damaged, or has other than 8 bits a channel or too many pixels.
    """
    with _opened_photograph(path) as image:
        _refuse_deep(path, image)
        transparent = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
        pixels = np.asarray(image.convert("RGBA" if transparent else "RGB"), dtype=np.float32) / np.float32(255)
    if not transparent:
        return pixels
    alpha = pixels[..., 3:]
    return pixels[..., :3] * alpha + np.asarray(background, np.float32) * (1 - alpha)


def read_thumbnail(path: Path, width: int, height: int, shape: float, tolerance: float) -> NDArray[np.float64]:
    """Read an image in few pixels, over black.

    Args:
        path: of the file.
        width, height: in pixels.
        shape: its width over its height, and tolerance: by how much of that it may differ.

    Returns:
        (height, width, 3), 0 to 1.

    Raises:
        As :func:`read_ground_truth`; and DataError if it has another shape.
    """
    with _opened_photograph(path) as image:
        _refuse_deep(path, image)
        if abs(image.width / image.height / shape - 1) > tolerance:
            raise DataError(f"'{path}' has another shape than its view")
        image.draft("RGB", (2 * width, 2 * height))  # a JPEG is decoded no finer than that
        small = image.convert("RGBA").resize((width, height), 4)  # Pillow's BOX: the mean
        pixels = np.asarray(small, dtype=np.float64) / 255
    return pixels[..., :3] * pixels[..., 3:]


def to_8_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Colours of any shape, clamped to [0, 1] and rounded to 0 … 255, uint8 of the same shape."""
    pixels = np.empty(image.shape, np.uint8)
    # In slices: each step makes a copy, of a picture of gigabytes too.
    rows = max(_SLICE * len(image) // max(image.size, 1), 1)
    for first in range(0, len(image), rows):
        pixels[first : first + rows] = np.rint(np.clip(image[first : first + rows], 0, 1) * 255)
    return pixels


def write_png(file: BinaryIO, pixels: NDArray[np.uint8], description: str = "") -> None:
    """Write (H, W, 3) 8-bit colours as PNG, with ``description`` as the text that PNG files can carry."""
    from PIL import Image, PngImagePlugin

    text = PngImagePlugin.PngInfo()
    if description:
        text.add_text("Description", description)
    Image.fromarray(pixels).save(file, format="PNG", pnginfo=text)
