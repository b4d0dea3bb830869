"""Energy compaction of the spherical harmonics: smaller coefficients that give the same colours where anyone looks.

Per splat and colour channel a ridge regression (paper section "Spherical harmonics energy compaction"): the colours in
the directions of the views that see the splat are matched, weighted by how much the splat shows in each, while all
coefficients but the constant (DC) one are pulled towards zero. Kernels: cl/compact/ridge*.cl*.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceError, UsageError
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device

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
#: Splats whose view weights are gathered at a time.
_GATHERED = 2048
#: Bytes of the splats that are on the device at a time: enough to fill it, little to pin.
_BATCHES = 64 << 20
#: Threads that copy to pinned memory: one does not reach what the bus carries.
_COPIERS = 4


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
        """Gather what :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances` gives.

        Args:
            splats: N.
            importances: per view its number, the splats that it sees, ascending, and I_k(s) of each, the mean over the
                view's pixels.
        """
        per_view = [(view, seen.astype(np.uint32), values.astype(np.float32)) for view, seen, values in importances]
        numbers = np.tile(np.array([view for view, _, _ in per_view], np.int32), _GATHERED)
        starts = np.arange(0, splats + _GATHERED, _GATHERED)
        bounds = [np.searchsorted(seen, starts) for _, seen, _ in per_view]
        offsets = np.zeros(splats + 1, np.int64)
        views = np.empty(sum(len(seen) for _, seen, _ in per_view), np.int32)
        weights = np.empty(len(views), np.float32)
        # Some splats at a time, so that what is written here and there stays in the cache.
        for block, start in enumerate(starts[:-1]):
            dense = np.zeros((min(_GATHERED, splats - start), len(per_view)), np.float32)
            for column, ((_, seen, values), bound) in enumerate(zip(per_view, bounds, strict=True)):
                run = slice(bound[block], bound[block + 1])
                dense[seen[run] - start, column] = values[run]
            counts = offsets[start + 1 : start + 1 + len(dense)]
            np.cumsum(np.count_nonzero(dense, axis=1), out=counts)
            counts += offsets[start]
            run = slice(offsets[start], offsets[start + len(dense)])
            present = np.flatnonzero(dense)
            views[run] = numbers[present]
            np.multiply(dense.ravel()[present], np.float32(REFERENCE_PIXELS), out=weights[run])
        return ViewWeights(offsets, views[: offsets[-1]], weights[: offsets[-1]])


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


class _Slot:
    """Device memory and a queue for one batch of splats.

    Two slots take turns, so that the host fills one while the device works on the other. GPUs copy from and to pinned
    memory, which they do on their own and several times as fast as from ordinary memory; CPUs copy from where data lie.
    """

    def __init__(self, device: Device, sizes: Sequence[tuple[int, str]]) -> None:
        self._device = device
        self._target: FloatArray | None = None
        self._compacted: FloatArray | None = None
        self._copied: Future[None] | None = None
        self._events: list[cl.Event] = []  # letting go of one waits for it
        self._mapped: list[NDArray[np.uint8]] = []
        self._maps: list[cl.MemoryMap] = []
        with device.all_or_nothing(), device.errors("cannot hold the splats to compact"):
            self.queue = device.queue
            if device.several_queues:
                self.queue = cl.CommandQueue(device.context, device.info.handle, properties=device.queue.properties)
            self.buffers = [device.allocate(nbytes, what) for nbytes, what in sizes]
            if device.family == "gpu":
                # One more than there are buffers: results are fetched while the next batch is filled in.
                self._mapped = [self._pinned(nbytes) for nbytes, _ in (*sizes, sizes[0])]

    def _pinned(self, nbytes: int) -> NDArray[np.uint8]:
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        buffer = cl.Buffer(self._device.context, flags, nbytes)
        access = cl.map_flags.READ | cl.map_flags.WRITE
        mapped: NDArray[np.uint8] = cl.enqueue_map_buffer(self.queue, buffer, access, 0, (nbytes,), np.uint8)[0]
        self._maps.append(mapped.base)
        return mapped

    def _staged(self, number: int, array: NDArray[Any]) -> NDArray[Any]:
        """The array where the device copies it from."""
        if not self._mapped:
            return np.ascontiguousarray(array)
        staged = self._mapped[number][: array.nbytes].view(array.dtype).reshape(array.shape)
        np.copyto(staged, array)
        return staged

    def upload(self, arrays: Sequence[NDArray[Any]], pool: ThreadPoolExecutor) -> None:
        """Fill the buffers, in their order."""
        staged = pool.map(self._staged, range(len(arrays)), arrays)
        with self._device.errors("failed to take the splats to compact"):
            for buffer, array in zip(self.buffers, staged, strict=True):
                if array.nbytes:
                    self._events.append(cl.enqueue_copy(self.queue, buffer, array, is_blocking=False))
            self.queue.flush()

    def download(self, target: FloatArray) -> None:
        """Begin to fetch the first buffer to a contiguous array; :meth:`collect` ends it."""
        if self._copied is not None:
            self._copied.result()
        self._target = self._compacted = target
        if self._mapped:
            self._compacted = self._mapped[-1][: target.nbytes].view(np.float32).reshape(target.shape)
        with self._device.errors("failed while computing"):
            self._events.append(cl.enqueue_copy(self.queue, self._compacted, self.buffers[0], is_blocking=False))
            self.queue.flush()

    def collect(self, pool: ThreadPoolExecutor) -> None:
        """Wait for what :meth:`download` began. The target is complete once the pool is."""
        if self._target is None or self._compacted is None:
            return
        with self._device.errors("failed while computing"):
            self.queue.finish()
        self._events.clear()
        if self._mapped:
            self._copied = pool.submit(np.copyto, self._target, self._compacted)
        self._target = None

    def close(self) -> None:
        """Give everything back."""
        with contextlib.suppress(cl.Error):
            self.queue.finish()
        self._events.clear()
        for mapped in self._maps:
            mapped.release(self.queue)
        for buffer in self.buffers:
            self._device.free(buffer)


class Compactor:
    """Compacts scenes on one device.

    Args:
        device: to compute on.
        memory: bytes of the device that splats may take at a time, in two batches; by default as much as keeps the
            device busy (64 MiB), at most a quarter of what it has.
    """

    def __init__(self, device: Device, memory: int | None = None) -> None:
        self.device = device
        self.memory = memory or min(device.info.memory // 4, _BATCHES)

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
            camera_centres: (S, 3) positions of the views that ``weights`` counts; or (S, J, 3) where each view stands
                for J positions, which share its weight.
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

        share = camera_centres.shape[1] if camera_centres.ndim == 3 else 1
        camera_centres = camera_centres.reshape(-1, 3)
        offsets = share * weights.offsets
        result = np.empty(scene.sh.shape, np.float32)
        batches = self._batches(offsets, count)
        most = max((stop - start for start, stop in batches), default=0)
        entries = max((int(offsets[stop] - offsets[start]) for start, stop in batches), default=0)
        sizes = (
            (12 * count * most, "the SH coefficients"),
            (16 * most, "the centres"),
            (4 * most, "the order of the splats"),
            (4 * (most + 1), "the offsets of the view weights"),
            (4 * max(entries, 1), "the views"),
            (4 * max(entries, 1), "the view weights"),
        )
        centres = np.zeros((len(camera_centres), 2, 4), np.float32)
        centres[:, 0, :3] = camera_centres
        centres[:, 1, :3] = camera_centres - centres[:, 0, :3].astype(np.float64)
        with contextlib.ExitStack() as stack:
            device_centres = self.device.upload(centres, "the cameras")
            stack.callback(self.device.free, device_centres)
            slots = [
                stack.enter_context(contextlib.closing(_Slot(self.device, sizes))) for _ in range(min(len(batches), 2))
            ]
            pool = stack.enter_context(ThreadPoolExecutor(_COPIERS))
            for number, (start, stop) in enumerate(batches):
                slot = slots[number % len(slots)]
                slot.collect(pool)
                slot.upload(_arrays(scene, weights, options, slice(start, stop), share), pool)
                seen = int(np.count_nonzero(offsets[start + 1 : stop + 1] > offsets[start:stop]))
                if seen:
                    self._launch(kernel, lanes, slot, device_centres, seen, options)
                slot.download(result[start:stop])
            for slot in slots:
                slot.collect(pool)
        # These came back as they were.
        result[np.diff(offsets) == 0, 1:] = 0
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
        return device.kernel(
            "compact/ridge.cl", "compact", LANES=lanes, SH_COUNT=sh_count, BLOCK=block, **variant
        ), lanes

    def _batches(self, offsets: NDArray[np.int64], sh_count: int) -> list[tuple[int, int]]:
        """Runs of splats of which two fit the memory budget, and one each of the device's buffers."""
        splats = len(offsets) - 1
        per_splat = 12 * sh_count + 24
        used = 8 * offsets + per_splat * np.arange(splats + 1)
        largest = self.device.info.largest_buffer
        batches = []
        start = 0
        while start < splats:
            stop = int(np.searchsorted(used, used[start] + self.memory // 2, side="right")) - 1
            stop = min(stop, start + largest // (12 * sh_count))
            stop = min(stop, int(np.searchsorted(offsets, offsets[start] + min(largest // 4, 2**32 - 1), "right")) - 1)
            stop = max(stop, start + 1)
            batches.append((start, stop))
            start = stop
        return batches

    def _launch(
        self,
        kernel: cl.Kernel,
        lanes: int,
        slot: _Slot,
        centres: cl.Buffer,
        splats: int,
        options: CompactionOptions,
    ) -> None:
        kernel.set_args(
            *slot.buffers,
            centres,
            np.uint32(splats),
            np.float32(options.alpha),
            np.float32(options.lam),
            np.float32(options.lam * options.chroma_factor),
            np.float32(options.sf_sh if options.two_pass else 0),
            np.int32(options.colour_model == "ycocg"),
        )
        items = -(-splats // lanes)
        # CPUs get one work-item a work-group: their kernels keep kilobytes of private memory each.
        group = _GROUP if self.device.family == "gpu" else 1
        self.device.launch(kernel, (-(-items // group) * group,), (group,), slot.queue)


def _arrays(
    scene: Scene, weights: ViewWeights, options: CompactionOptions, batch: slice, share: int
) -> tuple[NDArray[Any], ...]:
    """What the kernel takes of a batch of splats, in the order of its arguments; ``share`` positions to a view."""
    offsets = weights.offsets[batch.start : batch.stop + 1]
    entries = slice(int(offsets[0]), int(offsets[-1]))
    counts = np.diff(offsets)
    # Neighbours in a vector or a work-group run as long as the longest of them: they shall be alike.
    order = np.argsort(np.minimum(counts, 0xFFFF).astype(np.uint16), kind="stable").astype(np.uint32)
    means = np.zeros((len(counts), 4), np.float32)
    means[:, :3] = scene.means[batch]
    values = weights.weights[entries]
    if options.weighting == "visibility":
        values = (values > 0).astype(np.float32)
    views: NDArray[Any] = weights.views[entries]
    if share > 1:
        views = (share * views[:, None] + np.arange(share, dtype=np.int32)).ravel()
        values = np.repeat(values * np.float32(1 / share), share)
    return (
        scene.sh[batch],
        means,
        order[np.count_nonzero(counts == 0) :],
        (share * (offsets - offsets[0])).astype(np.uint32),
        views,
        values,
    )


def _check(splats: int, camera_centres: NDArray[np.floating[Any]], weights: ViewWeights) -> None:
    if len(weights.offsets) != splats + 1:
        raise UsageError(f"the view weights are of {len(weights.offsets) - 1} splats, the scene has {splats}")
    if camera_centres.ndim not in (2, 3) or camera_centres.shape[-1] != 3 or not np.isfinite(camera_centres).all():
        raise UsageError(f"camera centres of shape {camera_centres.shape} are not finite positions (S, 3) or (S, J, 3)")
    if len(weights.views) and not 0 <= weights.views.min() <= weights.views.max() < len(camera_centres):
        raise UsageError(f"the view weights name a view outside the {len(camera_centres)} given")
