"""Energy compaction of the spherical harmonics: smaller coefficients that give the same colours where anyone looks.

Per splat and colour channel a ridge regression (paper section "Spherical harmonics energy compaction"): the colours in
the directions of the views that see the splat are matched, weighted by how much the splat shows in each, while all
coefficients but the constant (DC) one are pulled towards zero. Kernels: cl/ridge*.cl*.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.device import Device
from potr_cl.errors import DeviceError, UsageError
from potr_cl.scene import FloatArray, Scene

ColourModel = Literal["ycocg", "rgb"]
Weighting = Literal["importance", "visibility"]
Precision = Literal["plain", "scaled", "refined", "orthogonal", "fp64"]

#: Weights are in pixels of an image of this many: lambda then means the same whatever size the views are rendered at.
#: Half a megapixel is about the size of the images on which the paper's figures for lambda were measured.
REFERENCE_PIXELS = 500_000

#: The largest weight and lambda whose squares and sums stay finite in single precision.
_LARGEST_WEIGHT = 1e12
_LARGEST_LAMBDA = 1e24

_CHOLESKY = {"ORTHOGONAL": 0, "DOUBLE": 0, "SCALED": 1, "SHIFT_DC": 1, "REFINEMENTS": 0}
_VARIANTS: dict[str, dict[str, int]] = {
    "plain": _CHOLESKY | {"SCALED": 0, "SHIFT_DC": 0},
    "scaled": _CHOLESKY,
    "refined": _CHOLESKY | {"REFINEMENTS": 1},
    "orthogonal": {"ORTHOGONAL": 1, "DOUBLE": 0, "SHIFT_DC": 1},
    "fp64": _CHOLESKY | {"DOUBLE": 1},
}
#: Work-items of a GPU's work-group.
_GROUP = 64


@dataclass(frozen=True)
class ViewWeights:
    """How much each splat shows in each view, sparse by splats (CSR).

    Attributes:
        offsets: (N + 1,) int64; splat k's entries are ``offsets[k]:offsets[k + 1]``.
        views: (K,) int32 index of the view, any order within a splat, none twice.
        weights: (K,) float32 mean of transmittance times alpha of the splat over the view's pixels, times
            :data:`REFERENCE_PIXELS`; from 0 up.

    Raises:
        UsageError: the arrays do not belong together.
    """

    offsets: NDArray[np.int64]
    views: NDArray[np.int32]
    weights: NDArray[np.float32]

    def __post_init__(self) -> None:
        offsets = self.offsets
        if offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0 or (np.diff(offsets) < 0).any():
            raise UsageError("view weights: offsets must start at 0 and never fall")
        if not self.views.shape == self.weights.shape == (int(offsets[-1]),):
            raise UsageError(
                f"view weights: offsets end at {offsets[-1]}, but there are {self.views.shape} views and "
                f"{self.weights.shape} weights"
            )
        if len(self.weights) and not (self.weights.min() >= 0 and self.weights.max() <= _LARGEST_WEIGHT):
            raise UsageError(f"view weights: a weight is negative, above {_LARGEST_WEIGHT:g} or not a number")

    @staticmethod
    def from_importances(
        splats: int, importances: Iterable[tuple[int, NDArray[np.integer[Any]], NDArray[np.floating[Any]]]]
    ) -> ViewWeights:
        """Gather what :meth:`potr_cl.removal.RemovalSweep.view_importances` gives.

        Args:
            splats: N.
            importances: per view its number, the splats that it sees, and I_k(s) of each, the mean over the view's
                pixels.
        """
        per_view = [(view, seen.astype(np.uint32), values.astype(np.float32)) for view, seen, values in importances]
        offsets = np.zeros(splats + 1, np.int64)
        for _, seen, _ in per_view:
            offsets[1:] += np.bincount(seen, minlength=splats)
        np.cumsum(offsets, out=offsets)
        views = np.empty(offsets[-1], np.int32)
        weights = np.empty(offsets[-1], np.float32)
        free = offsets[:-1].copy()
        for view, seen, values in per_view:
            places = free[seen]
            views[places] = view
            weights[places] = values * np.float32(REFERENCE_PIXELS)
            free[seen] += 1
        return ViewWeights(offsets, views, weights)


@dataclass(frozen=True)
class CompactionOptions:
    """How to compact.

    Attributes:
        lam: lambda of the first channel (Y, or each of R, G, B), pixels squared.
        alpha: a column of the basis matrix is dropped if its cosine with one used before it exceeds this; 1 keeps all.
        sf_sh: scale factor of the SH quantiser; what it rounds to 0 is forced to 0 by the second pass.
        chroma_factor: lambda of Co and Cg over that of Y.
        two_pass: solve again without the coefficients that would be quantised to 0.
        colour_model: the channels to solve (and to quantise, for the second pass) in.
        weighting: "importance" takes the weights, "visibility" 1 for every view in which the splat has any.
        precision: how the least squares are solved: "orthogonal" in float32 by Householder reflections; by Cholesky's
            factor of the normal equations in float32 "plain", "scaled" to a unit diagonal, or "refined" by one step
            more, and scaled in float64 ("fp64", if the device has it).

    Raises:
        UsageError: a value is out of range.
    """

    lam: float = 1.0
    alpha: float = 0.9
    sf_sh: float = 51.0
    chroma_factor: float = 3.0
    two_pass: bool = True
    colour_model: ColourModel = "ycocg"
    weighting: Weighting = "importance"
    precision: Precision = "orthogonal"

    def __post_init__(self) -> None:
        if not 0 <= self.lam <= _LARGEST_LAMBDA or not 0 <= self.lam * self.chroma_factor <= _LARGEST_LAMBDA:
            raise UsageError(
                f"lambda is {self.lam:g} and the chroma factor {self.chroma_factor:g}: each and their product must lie "
                f"between 0 and {_LARGEST_LAMBDA:g}"
            )
        if not 0 < self.alpha <= 1:
            raise UsageError(f"alpha is {self.alpha:g}, it must lie above 0 and be at most 1")
        if not 0 < self.sf_sh <= 1e9:
            raise UsageError(f"sf_sh is {self.sf_sh:g}, it must lie above 0 and be at most 1e9")
        for name, value, known in (
            ("colour model", self.colour_model, ("ycocg", "rgb")),
            ("weighting", self.weighting, ("importance", "visibility")),
            ("precision", self.precision, tuple(_VARIANTS)),
        ):
            if value not in known:
                raise UsageError(f"unknown {name} '{value}': choose one of {', '.join(known)}")


class Compactor:
    """Compacts scenes on one device.

    Args:
        device: to compute on.
        memory: bytes of the device that a batch of splats may take; by default a quarter of what it has, at most 1 GiB.
    """

    def __init__(self, device: Device, memory: int | None = None) -> None:
        self.device = device
        self.memory = memory or min(device.info.memory // 4, 1 << 30)

    def compact(
        self,
        scene: Scene,
        camera_centres: NDArray[np.floating[Any]],
        weights: ViewWeights,
        options: CompactionOptions | None = None,
    ) -> Scene:
        """The scene with new SH coefficients; everything else is shared with ``scene``.

        Splats in no view keep their DC term and lose the rest; a scene of degree 0 is returned as it is. A channel of a
        splat whose solution is not finite, is worse than its starting point, or holds an AC coefficient above four
        times max(1, norm of the channel's coefficients) keeps its original coefficients.

        Args:
            camera_centres: (S, 3) positions of the views that ``weights`` counts.
            weights: for the N splats of the scene.

        Raises:
            UsageError: scene, centres and weights do not belong together.
            DeviceError: the device fails, has no fp64 when that is asked for, or a batch of one splat does not fit.
        """
        options = options or CompactionOptions()
        splats, count = scene.sh.shape[:2]
        _check(splats, camera_centres, weights)
        if count == 1:
            return scene
        kernel, lanes = self._kernel(count, options)

        offsets = weights.offsets
        seen = np.diff(offsets) > 0
        result = np.empty(scene.sh.shape, np.float32)
        result[~seen, 0] = scene.sh[~seen, 0]
        result[~seen, 1:] = 0
        batches = self._batches(offsets, count)
        if not seen.any():
            return replace(scene, sh=result)

        most = max(stop - start for start, stop in batches)
        entries = max(int(offsets[stop] - offsets[start]) for start, stop in batches)
        eyes = np.zeros((len(camera_centres), 2, 4), np.float32)
        eyes[:, 0, :3] = camera_centres
        eyes[:, 1, :3] = camera_centres - eyes[:, 0, :3].astype(np.float64)
        buffers: list[cl.Buffer] = []
        try:
            for nbytes, what in (
                (12 * count * most, "the SH coefficients"),
                (16 * most, "the centres"),
                (4 * most, "the order of the splats"),
                (4 * (most + 1), "the offsets of the view weights"),
                (4 * entries, "the views"),
                (4 * entries, "the view weights"),
            ):
                buffers.append(self.device.allocate(nbytes, what))
            buffers.append(self.device.upload(eyes, "the cameras"))
            for start, stop in batches:
                self._run(kernel, lanes, buffers, scene, weights, options, slice(start, stop), result)
        finally:
            for buffer in buffers:
                self.device.free(buffer)
        return replace(scene, sh=result)

    def _kernel(self, sh_count: int, options: CompactionOptions) -> tuple[cl.Kernel, int]:
        """The kernel and how many splats a work-item of it takes."""
        device = self.device
        variant = _VARIANTS[options.precision]
        if variant["DOUBLE"] and "cl_khr_fp64" not in device.info.handle.extensions.split():
            raise DeviceError(f"device {device.info} has no double precision: choose another precision than 'fp64'")
        lanes = 1 if device.family == "gpu" else device.vector_width
        if variant["DOUBLE"] and lanes > 1:
            lanes = max(lanes // 2, 4)
        block = 4 if device.family == "gpu" else 8
        return device.kernel("ridge.cl", "compact", LANES=lanes, SH_COUNT=sh_count, BLOCK=block, **variant), lanes

    def _batches(self, offsets: NDArray[np.int64], sh_count: int) -> list[tuple[int, int]]:
        """Runs of splats that fit the memory budget and the device's largest buffer."""
        splats = len(offsets) - 1
        per_splat = 12 * sh_count + 24
        used = 8 * offsets + per_splat * np.arange(splats + 1)
        largest = self.device.info.largest_buffer
        batches = []
        start = 0
        while start < splats:
            stop = int(np.searchsorted(used, used[start] + self.memory, side="right")) - 1
            stop = min(stop, start + largest // (12 * sh_count))
            stop = min(stop, int(np.searchsorted(offsets, offsets[start] + min(largest // 4, 2**32 - 1), "right")) - 1)
            stop = max(stop, start + 1)
            batches.append((start, stop))
            start = stop
        return batches

    def _run(
        self,
        kernel: cl.Kernel,
        lanes: int,
        buffers: list[cl.Buffer],
        scene: Scene,
        weights: ViewWeights,
        options: CompactionOptions,
        batch: slice,
        result: FloatArray,
    ) -> None:
        device = self.device
        offsets = weights.offsets[batch.start : batch.stop + 1]
        entries = slice(int(offsets[0]), int(offsets[-1]))
        counts = np.diff(offsets)
        # Neighbours in a vector or a work-group run as long as the longest of them: they shall be alike.
        order = np.argsort(np.minimum(counts, 0xFFFF).astype(np.uint16), kind="stable").astype(np.uint32)
        order = order[np.count_nonzero(counts == 0) :]
        if not len(order):
            return
        means = np.zeros((len(counts), 4), np.float32)
        means[:, :3] = scene.means[batch]
        values = weights.weights[entries]
        if options.weighting == "visibility":
            values = (values > 0).astype(np.float32)
        uploads = (
            scene.sh[batch],
            means,
            order,
            (offsets - offsets[0]).astype(np.uint32),
            weights.views[entries],
            values,
        )
        with device.errors("failed to take the splats to compact"):
            for buffer, array in zip(buffers, uploads, strict=False):
                cl.enqueue_copy(device.queue, buffer, np.ascontiguousarray(array), is_blocking=True)
        kernel.set_args(
            *buffers,
            np.uint32(len(order)),
            np.float32(options.alpha),
            np.float32(options.lam),
            np.float32(options.lam * options.chroma_factor),
            np.float32(options.sf_sh if options.two_pass else 0),
            np.int32(options.colour_model == "ycocg"),
        )
        items = -(-len(order) // lanes)
        # CPUs get one work-item a work-group: their kernels keep kilobytes of private memory each.
        group = _GROUP if device.family == "gpu" else 1
        device.launch(kernel, (-(-items // group) * group,), (group,))
        compacted = device.download(buffers[0], (len(counts), *scene.sh.shape[1:]), np.float32)
        seen = counts > 0
        if seen.all():
            result[batch] = compacted
        else:
            result[batch][seen] = compacted[seen]


def _check(splats: int, camera_centres: NDArray[np.floating[Any]], weights: ViewWeights) -> None:
    if len(weights.offsets) != splats + 1:
        raise UsageError(f"the view weights are of {len(weights.offsets) - 1} splats, the scene has {splats}")
    if camera_centres.ndim != 2 or camera_centres.shape[1] != 3 or not np.isfinite(camera_centres).all():
        raise UsageError(f"camera centres of shape {camera_centres.shape} are not finite positions (S, 3)")
    if len(weights.views) and not 0 <= weights.views.min() <= weights.views.max() < len(camera_centres):
        raise UsageError(f"the view weights name a view outside the {len(camera_centres)} given")
