"""Scene: the arrays of a trained 3D Gaussian Splatting model, their units and their validation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError, UsageError
from potr_cl.host import mapped
from potr_cl.host.threads import thread_pool

FloatArray = NDArray[np.float32]

#: Splats looked at at a time where values are checked, and where threads do it, which wait for the interpreter.
_BLOCK, _THREAD_BLOCK = 1 << 14, 1 << 17
#: So many splats are copied by threads, an eighth of them at a time.
_LARGE = 1 << 17

#: The logit of an opacity that single precision cannot tell from 1.
_OPAQUE = np.float32(20)

#: Number of SH coefficients a colour channel for each degree.
SH_COEFFICIENTS = (1, 4, 9, 16)

#: Variance of the low-pass filter that a picture's splats are widened by, square pixels: that of the original
#: rasterizer, of gsplat and of viewers; and that of Mip-Splatting's code and of Brush's mip mode, which only
#: antialiased scenes can have.
LOW_PASS, MIP_SPLATTING_LOW_PASS = 0.3, 0.1


def most_coefficients(own_degree: int, degree: int | None) -> int:
    """SH coefficients of a channel up to a degree, of a scene that has those up to its own; None: all of these.

    Raises:
        UsageError: there is no such degree.
    """
    if degree is not None and not 0 <= degree < len(SH_COEFFICIENTS):
        raise UsageError(f"SH degree {degree} is unknown: choose 0 to {len(SH_COEFFICIENTS) - 1}")
    return SH_COEFFICIENTS[own_degree if degree is None else min(degree, own_degree)]


_ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def _cast(values: Any, name: str) -> FloatArray:
    if isinstance(values, np.ndarray) and values.dtype == np.float32:
        return values
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"{array.dtype} is no kind of real number")
        with np.errstate(over="ignore"):
            return array.astype(np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise DataError(
            f"scene: {name} is {type(values).__name__}, of which no array of float32 can be made: {said}"
        ) from None


@dataclass(frozen=True)
class CleanReport:
    """What :meth:`Scene.cleaned` had to mend.

    Attributes:
        non_finite: splats dropped because one of their values was NaN or infinite.
        zero_quaternions: splats whose quaternion had length zero and became the identity.
        infinite_opacities: splats whose logit was infinite, as decoders of 8-bit opacities write 0 and 1; it became
            a finite one of the same opacity.
    """

    non_finite: int
    zero_quaternions: int
    infinite_opacities: int


@dataclass(frozen=True, eq=False)
class Scene:
    """A trained scene, in the parametrisation that 3DGS files hold (Kerbl et al. 2023).

    All arrays are float32, N splats long, and may have any strides (the decoder returns ``sh`` with each
    coefficient contiguous in memory; nothing may assume otherwise of it). Other arrays of numbers, lists and tensors
    of the CPU are cast. ``scene[mask]`` selects splats, ``==`` compares all values.

    Attributes:
        means: (N, 3) centres in world units.
        log_scales: (N, 3) natural logarithm of the standard deviations along the splat's own axes.
        quaternions: (N, 4) rotation as w, x, y, z; not necessarily of unit length.
        opacity_logits: (N,) logit of the opacity.
        sh: (N, M, 3) spherical-harmonics coefficients, M = 1, 4, 9 or 16; [:, 0] is the DC term; the last
            axis is R, G, B.
        antialiased: whether it was trained with Mip-Splatting's antialiasing (Yu et al. 2024): in a picture, the
            low-pass filter then makes a splat wider and as much fainter, where it only makes it wider otherwise. See
            :class:`potr_cl.raster.rules.RasterRules`.
        low_pass: variance of that filter, square pixels: ``LOW_PASS``, or, if antialiased, ``MIP_SPLATTING_LOW_PASS``.

    Raises:
        DataError: shapes do not belong together, or the filter is another.
    """

    means: FloatArray
    log_scales: FloatArray
    quaternions: FloatArray
    opacity_logits: FloatArray
    sh: FloatArray
    antialiased: bool = False
    low_pass: float = LOW_PASS

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            object.__setattr__(self, name, _cast(getattr(self, name), name))
        n = len(self.means) if self.means.ndim else 0
        wanted = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,)}
        for name, shape in wanted.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise DataError(f"scene: {name} has shape {array.shape}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise DataError(f"scene: sh has shape {self.sh.shape}, expected ({n}, M, 3)")
        if self.sh.shape[1] not in SH_COEFFICIENTS:
            raise DataError(f"scene: {self.sh.shape[1]} SH coefficients a channel, expected one of {SH_COEFFICIENTS}")
        if self.low_pass != LOW_PASS and not (self.antialiased and self.low_pass == MIP_SPLATTING_LOW_PASS):
            raise DataError(
                f"scene: a low-pass filter of {self.low_pass:g} square pixels, expected {LOW_PASS:g}, or for an "
                f"antialiased scene {MIP_SPLATTING_LOW_PASS:g}"
            )

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Any) -> Scene:
        """The splats of a boolean mask, of numbers or of a slice; of one number, a scene of one splat."""
        if isinstance(index, (int, np.integer)):
            index = [index]
        if not isinstance(index, slice):
            index = np.asarray(index)
            # Of an empty list NumPy makes floats.
            index = index if index.size else index.astype(np.intp)
        return self.subset(np.arange(len(self))[index])

    def __iter__(self) -> NoReturn:
        raise TypeError("a scene is no sequence of splats: look at its arrays, such as scene.means")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scene):
            return NotImplemented
        same = (self.antialiased, self.low_pass) == (other.antialiased, other.low_pass)
        return same and all(map(np.array_equal, self.arrays, other.arrays))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_COEFFICIENTS.index(self.sh.shape[1])

    @staticmethod
    def blank(splats: int, coefficients: int, like: Scene | None = None, by_splat: bool = False) -> Scene:
        """A scene whose arrays are still to be filled.

        Args:
            splats: N.
            coefficients: M, of a channel.
            like: to be rendered as this one; None: classic.
            by_splat: whether a splat's SH coefficients stand together, as readers fill them first of all, instead of
                each coefficient being contiguous in memory.
        """
        shape = (splats, coefficients, 3) if by_splat else (coefficients, 3, splats)
        sh = mapped.array(shape, np.float32, "SH coefficients", first=by_splat)
        scene = Scene(
            np.empty((splats, 3), np.float32),
            np.empty((splats, 3), np.float32),
            np.empty((splats, 4), np.float32),
            np.empty(splats, np.float32),
            sh if by_splat else sh.transpose(2, 0, 1),
        )
        return scene if like is None else like.of_arrays(scene.arrays)

    @property
    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """means, log_scales, quaternions, opacity_logits and sh."""
        return self.means, self.log_scales, self.quaternions, self.opacity_logits, self.sh

    def of_arrays(self, arrays: Sequence[FloatArray]) -> Scene:
        """A scene to be rendered like this one, of other :attr:`arrays`."""
        means, log_scales, quaternions, opacity_logits, sh = arrays
        return Scene(means, log_scales, quaternions, opacity_logits, sh, self.antialiased, self.low_pass)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in self.arrays)

    @property
    def scales(self) -> FloatArray:
        """(N, 3) standard deviations in world units; infinite where single precision cannot hold them."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_scales)

    @property
    def opacities(self) -> FloatArray:
        """(N,) opacities in (0, 1)."""
        return opacities_of(self.opacity_logits)

    def __repr__(self) -> str:
        low, high = (self.means.min(axis=0), self.means.max(axis=0)) if len(self) else (np.zeros(3), np.zeros(3))
        box = " x ".join(f"[{a:.3g}, {b:.3g}]" for a, b in zip(low, high, strict=True))
        return f"Scene({len(self):,} splats, SH degree {self.sh_degree}, {box}, {self.nbytes / 1e6:.1f} MB)"

    def uncoloured(self) -> Scene:
        """The same splats, all black, for those who do not look at colours: black takes no memory."""
        return dataclasses.replace(self, sh=np.broadcast_to(np.float32(0), (len(self), 1, 3)))

    def subset(self, index: NDArray[np.generic]) -> Scene:
        """The splats that ``index`` (integers or a boolean mask) selects, in its order."""
        numbers = np.asarray(index)
        if (sh := mapped.rows(self.sh, numbers, "SH coefficients")) is not None:
            return self.of_arrays([*(each[numbers] for each in self.arrays[:-1]), sh])
        # Much quicker for whole rows than indexing.
        fast = numbers.dtype.kind in "iu" and self.sh.flags.c_contiguous
        if not fast:
            return self.of_arrays([each[index] for each in self.arrays])
        rows = numbers.astype(np.intp, copy=False)
        if len(rows) >= _LARGE and rows.min() >= 0 and rows.max() < len(self):
            return self._rows(rows)
        return self.of_arrays([each.take(rows, axis=0) for each in self.arrays])

    def _rows(self, numbers: NDArray[np.intp]) -> Scene:
        """:meth:`subset` of many splats: the memory that is new takes longer than the copy, and threads share it."""
        given = self.arrays
        taken = [np.empty((len(numbers), *each.shape[1:]), each.dtype) for each in given]

        def take(first: int) -> None:
            some = slice(first, first + _LARGE // 8)
            for each, result in zip(given, taken, strict=True):
                each.take(numbers[some], axis=0, out=result[some], mode="clip")  # without a copy in between

        return self._of_runs(take, taken)

    def _of_runs(self, take: Callable[[int], None], arrays: Sequence[FloatArray]) -> Scene:
        """A scene like this one of other arrays, which threads fill by runs: ``take`` gets where each begins."""
        with thread_pool() as pool:
            list(pool.map(take, range(0, len(arrays[0]), _LARGE // 8)))
        return self.of_arrays(arrays)

    def joined(self, other: Scene, order: NDArray[np.int64]) -> Scene:
        """The splats of this scene and of another one of the same SH degree, each once.

        Args:
            other: the other one.
            order: (N,) their numbers, those of the other one's splats counted on from this one's.
        """
        given = list(zip(self.arrays, other.arrays, strict=True))
        made = [np.empty((len(order), *own.shape[1:]), np.float32) for own, _ in given[:-1]]
        made.append(mapped.array((len(order), *self.sh.shape[1:]), np.float32, "SH coefficients"))

        def take(first: int) -> None:
            numbers = order[first : first + _LARGE // 8]
            others = np.flatnonzero(numbers >= len(self))
            for (own, its), result in zip(given, made, strict=True):
                some = result[first : first + len(numbers)]
                if own.flags.c_contiguous and len(own):
                    # Of the others anything at first. Much quicker for whole rows than indexing.
                    own.take(numbers, axis=0, out=some, mode="clip")
                else:
                    mine = np.flatnonzero(numbers < len(self))
                    some[mine] = own[numbers[mine]]
                some[others] = its[numbers[others] - len(self)]

        return self._of_runs(take, made)  # the memory that is new takes longer than the copies

    def put(self, first: int, part: Scene) -> None:
        """Replace the splats from number ``first`` on by those of another scene of the same SH degree, in place."""
        own = slice(first, first + len(part))
        for array, its in zip(self.arrays, part.arrays, strict=True):
            array[own] = its

    def rendered(self, antialiased: bool | None) -> Scene:
        """The scene as it is to be rendered: antialiased, classic, or, for None, as it was trained.

        One that is antialiased already keeps its filter; a classic one has ``LOW_PASS``.
        """
        if antialiased is None or antialiased == self.antialiased:
            return self
        return dataclasses.replace(self, antialiased=antialiased, low_pass=LOW_PASS)

    def cleaned(self) -> tuple[Scene, CleanReport]:
        """Drop splats with non-finite values, turn zero quaternions into the identity, infinite opacity logits finite.

        Returns:
            The clean scene (``self`` if nothing had to be mended) and what was mended.

        Raises:
            DataError: no splat is left.
        """
        infinite = np.isinf(self.opacity_logits)
        infinite_opacities = int(np.count_nonzero(infinite))
        if infinite_opacities:
            logits = np.where(infinite, np.copysign(_OPAQUE, self.opacity_logits), self.opacity_logits)
            scene, report = dataclasses.replace(self, opacity_logits=logits).cleaned()
            return scene, dataclasses.replace(report, infinite_opacities=infinite_opacities)
        finite = np.ones(len(self), bool)

        def look(start: int, stop: int) -> None:
            """Block by block the temporaries stay in the cache, and one without fault is done at the first look."""
            for first in range(start, stop, _BLOCK):
                rows = slice(first, min(first + _BLOCK, stop))
                for array in self.arrays:
                    ok = np.isfinite(array[rows])
                    if not ok.all():
                        finite[rows] &= ok.reshape(len(ok), -1).all(axis=1)

        _over_blocks(look, len(self))
        dropped = len(self) - int(np.count_nonzero(finite))
        scene = self.subset(finite) if dropped else self
        if len(scene) == 0:
            raise DataError("the scene has no splat with finite values: nothing to do")
        zero = np.empty(len(scene), bool)

        def measure(start: int, stop: int) -> None:
            """A length whose square underflows cannot be normalised either."""
            some = scene.quaternions[start:stop]
            zero[start:stop] = np.einsum("ij,ij->i", some, some, dtype=np.float64) < 1e-30

        _over_blocks(measure, len(scene))
        zeros = int(np.count_nonzero(zero))
        if zeros:
            quaternions = scene.quaternions.copy()
            quaternions[zero] = (1, 0, 0, 0)
            scene = dataclasses.replace(scene, quaternions=quaternions)
        return scene, CleanReport(dropped, zeros, 0)


def _over_blocks(work: Callable[[int, int], None], splats: int) -> None:
    """Call something with where each block of splats begins and ends; by threads, if there are many."""
    if splats < _LARGE:
        work(0, splats)
        return
    starts = range(0, splats, _THREAD_BLOCK)
    with thread_pool() as pool:
        list(pool.map(work, starts, (min(start + _THREAD_BLOCK, splats) for start in starts)))


def joined(parts: Sequence[Scene]) -> Scene:
    """The splats of some scenes of the same kind and SH degree, one after another.

    Each SH coefficient is contiguous in memory. The scene itself, if there is one alone.
    """
    if len(parts) == 1:
        return parts[0]
    whole = Scene.blank(sum(map(len, parts)), parts[0].sh.shape[1], parts[0])
    first = 0
    for part in parts:
        whole.put(first, part)
        first += len(part)
    return whole


def opacities_of(logits: FloatArray) -> FloatArray:
    """(N,) opacities in (0, 1) that have these logits."""
    # exp of a non-positive number only: a logit of -100 must not overflow.
    e = np.exp(-np.abs(logits))
    return np.where(logits >= 0, 1 / (1 + e), e / (1 + e)).astype(np.float32)
