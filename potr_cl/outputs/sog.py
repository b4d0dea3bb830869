"""SOG files (PlayCanvas, .sog) as an output: a palette of AC coefficients by rate and distortion, and coarse steps."""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.kmeans import Rate, assigned, cluster
from potr_cl.codec.encoder import Coded
from potr_cl.codec.geometry import distances_to_views
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import sog
from potr_cl.formats.scenes.sog_images import PALETTE, Palette, SogImages, bundle
from potr_cl.formats.scenes.sog_values import areas
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene
from potr_cl.outputs.sog_geometry import SogGeometry, rounded_geometry

#: Bits that a splat takes, about: with what a splat may cost in error they say what a bit may.
_BITS_A_SPLAT = 90
#: Bits that an entry of the palette has to be worth; and the most entries to begin with, as a part of the splats. An
#: entry takes some 60 bits: but points leave a dear one all at once.
_BITS_AN_ENTRY, _MOST_A_SPLAT = 20, 0.75
#: What an error is worth at least, as a part of what it were if the constant coefficient could not make up for it:
#: other views than those of the re-fit may tell them better apart.
_LEAST_WORTH = 0.02
#: Splats that a thread works on at a time.
_BLOCK = 1 << 14
#: An entry has many splats if it has so many.
_MANY = 4
#: What the images hold.
_IMAGES = {
    "means_l": "position",
    "means_u": "position",
    "scales": "scale",
    "quats": "rotation",
    "sh0": "colour: DC, opacity",
    "shN_centroids": "colour: AC",
    "shN_labels": "colour: AC",
}
#: Steps of R, G and B that are as coarse as those of Y, Co and Cg of 1.
_STEP_OF_CHANNEL = math.sqrt(8 / 3)


@dataclass(frozen=True)
class SogRounded(RoundedScene):
    """:class:`RoundedScene` with what the file has of it.

    Attributes:
        geometry: all but colours, in the order of the file.
        worth: (N, M) bits that an error of 1 in a coefficient of one channel is worth; None before :meth:`Sog.fix_ac`.
        palette: None before that, and for a scene of SH degree 0.
    """

    geometry: SogGeometry | None = None
    worth: FloatArray | None = None
    palette: Palette | None = None


@dataclass(frozen=True)
class Sog(Output):
    """A .sog file, version 2."""

    format: ClassVar[SceneFormat] = sog.FORMAT
    choices: ClassVar[frozenset[str]] = frozenset(
        {"gamma", "beta", "sf_opacity", "sf_rotation", "sf_scale", "sf_dc", "sf_sh"}
    )
    fixes_ac: ClassVar[bool] = True
    bytes_a_splat: ClassVar[float] = 1.1

    def geometry(self, scene: Scene, request: Request) -> SogRounded:
        """See :func:`potr_cl.outputs.sog_geometry.rounded_geometry`."""
        with thread_pool(request.threads) as pool:
            distances = distances_to_views(scene.means, request.views, pool.map)
            geometry = rounded_geometry(scene, request.parameters, distances, pool.map)
        return SogRounded(request.parameters, geometry.order, geometry.seen(scene), geometry=geometry)

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[SogRounded, FloatArray]:
        """A palette whose entries and labels are worth the bytes that they take."""
        assert isinstance(rounded, SogRounded)
        made_up = None
        if worth is not None and request.blocks is not None:
            made_up, worth = _made_up(request.blocks(), worth, request.threads)
        bits = _worth_in_bits(rounded, sh, worth, request)
        if sh.shape[1] == 1:
            return replace(rounded, worth=bits), sh
        device = request.device or Device()
        order = rounded.order
        points = np.empty((len(sh), sh.shape[1] - 1, 3), np.float32)
        weights = np.empty(points.shape[:2], np.float32)

        def arrange(start: int) -> None:
            some = slice(start, start + _BLOCK)
            points[some] = sh[order[some], 1:]  # take() would make a copy of all: each coefficient is contiguous
            weights[some] = bits[order[some], 1:]

        with thread_pool(request.threads) as pool:
            list(pool.map(arrange, range(0, len(sh), _BLOCK)))
        most = min(max(int(len(points) * _MOST_A_SPLAT), 1), PALETTE)
        found = cluster(device, points, weights, most, Rate(_BITS_AN_ENTRY))
        palette = _coded(device, points, weights, found.centres, found.labels)
        fixed = np.empty_like(sh)
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        entries = palette.book.take(palette.entries)

        def fix(start: int) -> None:
            some = slice(start, start + _BLOCK)
            fixed[some, 0] = sh[some, 0]
            fixed[some, 1:] = entries.take(palette.labels.take(back[some]), axis=0)
            if made_up is not None:
                fixed[some, 0] += np.einsum("nm,nmc->nc", made_up[some], sh[some, 1:] - fixed[some, 1:])

        with thread_pool(request.threads) as pool:
            list(pool.map(fix, range(0, len(sh), _BLOCK)))
        return replace(rounded, worth=bits, palette=palette), fixed

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """Levels of the constant coefficients, then the images."""
        request.progress("pack", 0.0)
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, SogRounded)
        geometry, worth = rounded.geometry, rounded.worth
        assert geometry is not None
        assert worth is not None
        order = rounded.order
        constant = graded(sh[order, 0], worth[order, 0])
        images = SogImages(
            geometry.least,
            geometry.most,
            geometry.steps,
            geometry.quaternions,
            geometry.scale_book,
            geometry.scales,
            constant.book,
            np.concatenate([constant.levels, geometry.opacities[:, None]], axis=1),
            rounded.palette,
            scene.antialiased,
        )
        pieces = [bundle(images)]
        request.progress("pack", 1.0)
        return Coded(pieces, order)

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes of the images by what they hold; the description and the archive's own are "other"."""
        sums = dict.fromkeys((*_IMAGES.values(), "other"), 0)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for entry in archive.infolist():
                sums[_IMAGES.get(PurePosixPath(entry.filename).stem, "other")] += entry.compress_size
        sums["other"] += self.size([data]) - sum(sums.values())
        return {name: nbytes for name, nbytes in sums.items() if nbytes}


def _made_up(blocks: FloatArray, worth: FloatArray, threads: int) -> tuple[FloatArray, FloatArray]:
    """By how much the constant coefficient takes back an error of 1 in each of the others; what such errors cost then.

    Seen from one side alone, an error of another coefficient is nearly one of the constant one.

    Args:
        blocks: as of :attr:`Request.blocks`; its first rows are what the constant coefficient shares with each.
        worth: (N, M).
        threads: to work with.

    Returns:
        (N, M − 1), and (N, M).
    """
    made_up, left = np.empty((len(worth), worth.shape[1] - 1), np.float32), np.empty_like(worth)

    def find(start: int) -> None:
        some = slice(start, start + _BLOCK)
        constant, cost = blocks[0, some], worth[some]
        made_up[some] = (blocks[1 : worth.shape[1], some] / np.where(constant > 0, constant, 1)).T
        left[some, 0] = cost[:, 0]
        others = cost[:, 1:]
        left[some, 1:] = np.maximum(others - cost[:, :1] * np.square(made_up[some]), _LEAST_WORTH * others)

    with thread_pool(threads) as pool:
        list(pool.map(find, range(0, len(worth), _BLOCK)))
    return made_up, left


def _worth_in_bits(rounded: SogRounded, sh: FloatArray, worth: FloatArray | None, request: Request) -> FloatArray:
    """(N, M) float32: bits that an error of 1 in a coefficient of one channel is worth.

    Without views a splat's errors count as much as it covers, and on average as the scale factors of colours say.
    """
    parameters = request.parameters
    if worth is not None:
        return worth * np.float32(_BITS_A_SPLAT / max(parameters.delta_mse_max, 1e-30))
    shown = areas(rounded.scene)
    shown = (shown / max(float(shown.mean()), 1e-30)).astype(np.float32)
    factors = np.full(sh.shape[1], parameters.sf_sh / _STEP_OF_CHANNEL, np.float32)
    factors[0] = parameters.sf_dc / _STEP_OF_CHANNEL
    bits: FloatArray = (shown[:, None] * np.square(factors) * STEP_OF_BIT).astype(np.float32)
    return bits


def _coded(
    device: Device, points: FloatArray, weights: FloatArray, centres: FloatArray, labels: NDArray[np.uint32]
) -> Palette:
    """A palette of some sets, whose coefficients are rounded; then each splat takes the best one once more."""
    count = len(centres)
    with thread_pool() as pool:
        mass = np.stack(list(pool.map(lambda column: np.bincount(labels, column, count), weights.T)), axis=1)
    levels = graded(centres, mass.astype(np.float32))
    having = np.bincount(labels, minlength=count)
    with np.errstate(divide="ignore"):
        bits = np.minimum(-np.log2(having / len(points)), 64).astype(np.float32)
    labels = assigned(device, points, weights, levels.values, bits)
    having = np.bincount(labels, minlength=count)
    first = np.full(count, len(labels))
    np.minimum.at(first, labels, np.arange(len(labels)))
    # Those of many splats first, as few bits tell them; of others, those that are used near each other stand together.
    order = np.lexsort([first, -np.minimum(having, _MANY)])
    order = order[having[order] > 0]
    places = np.empty(count, np.int64)
    places[order] = np.arange(len(order))
    return Palette(levels.book, levels.levels[order], places[labels].astype(np.uint16))


#: A uniform quantiser's error falls by 2 ln 2 of itself for a bit more, and is a twelfth of the squared step: so its
#: step, squared, is this over what an error of 1 is worth in bits.
STEP_OF_BIT = 12 / (2 * np.log(2))
#: The finest steps, as a part of those of a number of mean weight; and the most doublings of them.
_FINEST, _MOST_DOUBLINGS = 0.5, 3
#: Levels of a book, and those that are even at most; the others are for the few numbers beyond.
_LEVELS, _EVEN = 256, 224
#: The part of the numbers on either side that are beyond.
_BEYOND = 0.0005


@dataclass(frozen=True)
class Graded:
    """Numbers as levels.

    Attributes:
        book: (up to 256,) float32, ascending; 0 is in it.
        levels: uint8, of the numbers' shape.
    """

    book: FloatArray
    levels: NDArray[np.uint8]

    @property
    def values(self) -> FloatArray:
        """What readers see."""
        return self.book[self.levels]


def graded(values: FloatArray, worth: FloatArray) -> Graded:
    """Levels for some numbers.

    Args:
        values: (..., C) float32.
        worth: (...,) of an error of 1 in one of the C, squared errors adding up, in bits.
    """
    mean = float(worth.mean(dtype=np.float64))
    low, high = np.quantile(values, [_BEYOND, 1 - _BEYOND])
    finest = _FINEST * np.sqrt(STEP_OF_BIT / mean) if mean > 0 else np.inf
    if high - low > finest * (_EVEN - 2):  # more levels than there are: the best 256
        weights = np.broadcast_to(worth[..., None], values.shape).reshape(-1).astype(np.float64)
        book = _with_zero(codebook(values.reshape(-1), weights, _LEVELS - 1))
        return Graded(book, nearest(values, book).astype(np.uint8))
    if not np.isfinite(finest):
        finest = max(float(high - low), 1.0)
    with np.errstate(divide="ignore"):
        wanted = np.log2(np.sqrt(STEP_OF_BIT / worth.astype(np.float64)) / finest)
    size = finest * 2.0 ** np.clip(np.round(wanted), 0, _MOST_DOUBLINGS)[..., None]
    first, last = np.floor(low / finest), np.ceil(high / finest)
    even = (np.arange(min(first, 0), max(last, 0) + 1) * finest)[:_LEVELS]
    outer = values[(values < even[0] - finest / 2) | (values > even[-1] + finest / 2)]
    beyond = codebook(outer, None, _LEVELS - len(even)) if len(outer) and len(even) < _LEVELS else outer[:0]
    book = np.unique(np.concatenate([even.astype(np.float32), beyond]))
    rounded = np.where((values >= even[0]) & (values <= even[-1]), np.rint(values / size) * size, values)
    return Graded(book, nearest(rounded, book).astype(np.uint8))


def _with_zero(book: FloatArray) -> FloatArray:
    return np.unique(np.concatenate([book, np.zeros(1, np.float32)]))
