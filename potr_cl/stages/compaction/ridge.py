"""Energy compaction of the spherical harmonics: smaller coefficients that give the same colours where anyone looks.

Per splat and colour channel a ridge regression (paper section "Spherical harmonics energy compaction"): the colours in
the directions of the views that see the splat are matched, weighted by how much the splat shows in each, while all
coefficients but the constant (DC) one are pulled towards zero. Kernels: cl/compact/ridge*.cl*.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.stages.compaction.view_weights import ViewWeights


class Slot(Owner):
    """Device memory and a queue for one batch of splats.

    Two slots take turns, so that the host fills one while the device works on the other. GPUs copy from and to pinned
    memory, which they do on their own and several times as fast as from ordinary memory; CPUs copy from where data lie.

    Args:
        device: to which the batches go.
        sizes: bytes of each buffer and what it holds, by name. The first is the one that comes back.
        pinned: whether to copy by way of pinned memory.

    Attributes:
        buffers: by name. queue: that fills them and fetches the first one.
    """

    def __init__(self, device: Device, sizes: Mapping[str, tuple[int, str]], pinned: bool) -> None:
        self._device = device
        self._memory = Memory(device)
        self._target: FloatArray | None = None
        self._compacted: FloatArray | None = None
        self._copied: Future[None] | None = None
        self._events: list[cl.Event] = []  # letting go of one waits for it
        self._mapped: dict[str, NDArray[np.uint8]] = {}
        self._fetched: NDArray[np.uint8] | None = None
        self._maps: list[cl.MemoryMap] = []
        self._result = next(iter(sizes))
        with device.all_or_nothing(), device.errors("cannot hold the splats to compact"):
            self.queue = device.queue
            if device.several_queues:
                self.queue = cl.CommandQueue(device.context, device.info.handle, properties=device.queue.properties)
            self.buffers = {name: self._memory.allocate(nbytes, what) for name, (nbytes, what) in sizes.items()}
            if pinned:
                self._mapped = {name: self._pinned(nbytes) for name, (nbytes, _) in sizes.items()}
                # Results are fetched while the next batch is filled in.
                self._fetched = self._pinned(sizes[self._result][0])

    def _pinned(self, nbytes: int) -> NDArray[np.uint8]:
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        buffer = cl.Buffer(self._device.context, flags, nbytes)
        access = cl.map_flags.READ | cl.map_flags.WRITE
        mapped: NDArray[np.uint8] = cl.enqueue_map_buffer(self.queue, buffer, access, 0, (nbytes,), np.uint8)[0]
        self._maps.append(mapped.base)
        return mapped

    def _staged(self, name: str, array: NDArray[Any]) -> NDArray[Any]:
        """The array where the device copies it from."""
        if not self._mapped:
            return np.ascontiguousarray(array)
        staged = self._mapped[name][: array.nbytes].view(array.dtype).reshape(array.shape)
        np.copyto(staged, array)
        return staged

    def upload(self, arrays: Mapping[str, NDArray[Any]], pool: ThreadPoolExecutor) -> None:
        """Fill the buffers of these names."""
        staged = pool.map(self._staged, arrays.keys(), arrays.values())
        with self._device.errors("failed to take the splats to compact"):
            for name, array in zip(arrays, staged, strict=True):
                if array.nbytes:
                    self._events.append(cl.enqueue_copy(self.queue, self.buffers[name], array, is_blocking=False))
            self.queue.flush()

    def download(self, target: FloatArray) -> None:
        """Begin to fetch the first buffer to a contiguous array; :meth:`collect` ends it."""
        if self._copied is not None:
            self._copied.result()
        self._target = self._compacted = target
        if self._fetched is not None:
            self._compacted = self._fetched[: target.nbytes].view(np.float32).reshape(target.shape)
        source = self.buffers[self._result]
        with self._device.errors("failed while computing"):
            self._events.append(cl.enqueue_copy(self.queue, self._compacted, source, is_blocking=False))
            self.queue.flush()

    def collect(self, pool: ThreadPoolExecutor) -> None:
        """Wait for what :meth:`download` began. The target is complete once the pool is."""
        if self._target is None or self._compacted is None:
            return
        with self._device.errors("failed while computing"):
            self.queue.finish()
        self._events.clear()
        if self._fetched is not None:
            self._copied = pool.submit(np.copyto, self._target, self._compacted)
        self._target = None

    def close(self) -> None:
        with contextlib.suppress(cl.Error):
            self.queue.finish()
        self._events.clear()
        for mapped in self._maps:
            mapped.release(self.queue)
        self._maps.clear()
        self._memory.close()


ColourModel = Literal["ycocg", "rgb"]
Weighting = Literal["importance", "visibility"]
Precision = Literal["orthogonal", "cholesky"]

#: The largest lambda whose squares and sums stay finite in single precision.
_LARGEST_LAMBDA = 1e24

#: Bytes of the splats that are on the device at a time: enough to fill it, little to pin.
_BATCHES = 64 << 20
#: Threads that copy to pinned memory: one does not reach what the bus carries.
_COPIERS = 4


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
        precision: how the least squares are solved: "orthogonal" by Householder reflections, or "cholesky", faster and
            less exact, by Cholesky's factor of the normal equations, scaled to a unit diagonal.

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
            ("precision", self.precision, ("orthogonal", "cholesky")),
        ):
            if value not in known:
                raise UsageError(f"unknown {name} '{value}': choose one of {', '.join(known)}")


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
            DeviceError: the device fails, or a batch of one splat does not fit.
        """
        options = options or CompactionOptions()
        splats, count = scene.sh.shape[:2]
        _check(splats, camera_centres, weights)
        if count == 1:
            return scene
        gpu = self.device.family == "gpu"
        kernel, group, together = self._kernel(count, options.precision)

        share = camera_centres.shape[1] if camera_centres.ndim == 3 else 1
        camera_centres = camera_centres.reshape(-1, 3)
        offsets = share * weights.offsets
        result = np.empty(scene.sh.shape, np.float32)
        batches = self._batches(offsets, count)
        most = max((stop - start for start, stop in batches), default=0)
        entries = max((int(offsets[stop] - offsets[start]) for start, stop in batches), default=0)
        sizes = {
            "sh": (12 * count * most, "the SH coefficients"),
            "means": (16 * most, "the centres"),
            "order": (4 * most, "the order of the splats"),
            "offsets": (4 * (most + 1), "the offsets of the view weights"),
            "view_numbers": (4 * max(entries, 1), "the views"),
            "weights": (4 * max(entries, 1), "the view weights"),
        }
        centres = np.zeros((len(camera_centres), 2, 4), np.float32)
        centres[:, 0, :3] = camera_centres
        centres[:, 1, :3] = camera_centres - centres[:, 0, :3].astype(np.float64)
        with contextlib.ExitStack() as stack:
            memory = stack.enter_context(Memory(self.device))
            device_centres = memory.upload(centres, "the cameras")
            slots = [stack.enter_context(Slot(self.device, sizes, gpu)) for _ in range(min(len(batches), 2))]
            pool = stack.enter_context(ThreadPoolExecutor(_COPIERS))
            for number, (start, stop) in enumerate(batches):
                slot = slots[number % len(slots)]
                slot.collect(pool)
                slot.upload(_arrays(scene, weights, options, slice(start, stop), share), pool)
                seen = int(np.count_nonzero(offsets[start + 1 : stop + 1] > offsets[start:stop]))
                if seen:
                    kernel.bind(
                        **slot.buffers,
                        camera_centres=device_centres,
                        splats=seen,
                        threshold=options.alpha,
                        lambda_luma=options.lam,
                        lambda_chroma=options.lam * options.chroma_factor,
                        scale_factor=options.sf_sh if options.two_pass else 0,
                        ycocg=options.colour_model == "ycocg",
                    )
                    groups = -(-seen // together)
                    kernel.launch((groups * group,), (group,), slot.queue)
                slot.download(result[start:stop])
            for slot in slots:
                slot.collect(pool)
        # These came back as they were.
        result[np.diff(offsets) == 0, 1:] = 0
        return replace(scene, sh=result)

    def _kernel(self, count: int, precision: Precision) -> tuple[Kernel, int, int]:
        """The kernel for so many coefficients, work-items of its groups, and the splats that these do together."""
        gpu = self.device.family == "gpu"
        if gpu and precision == "orthogonal" and self.device.info.indexes_in_memory:
            return self.device.kernel("compact/ridge_shared.cl", "compact", SH_COUNT=count), 64, 4
        # A CPU's work-groups have one work-item: these kernels keep kilobytes of private memory each.
        lanes, group = (1, 64) if gpu else (self.device.vector_width, 1)
        kernel = self.device.kernel(
            "compact/ridge.cl",
            "compact",
            ORTHOGONAL=int(precision == "orthogonal"),
            LANES=lanes,
            SH_COUNT=count,
            BLOCK=4 if gpu else 8,  # rows of the basis matrix that are reduced at a time
        )
        return kernel, group, lanes * group

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


def _arrays(
    scene: Scene, weights: ViewWeights, options: CompactionOptions, batch: slice, share: int
) -> dict[str, NDArray[Any]]:
    """What the kernel takes of a batch of splats, by its arguments' names; ``share`` positions to a view."""
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
    return {
        "sh": scene.sh[batch],
        "means": means,
        "order": order[np.count_nonzero(counts == 0) :],
        "offsets": (share * (offsets - offsets[0])).astype(np.uint32),
        "view_numbers": views,
        "weights": values,
    }


def _check(splats: int, camera_centres: NDArray[np.floating[Any]], weights: ViewWeights) -> None:
    if len(weights.offsets) != splats + 1:
        raise UsageError(f"the view weights are of {len(weights.offsets) - 1} splats, the scene has {splats}")
    if camera_centres.ndim not in (2, 3) or camera_centres.shape[-1] != 3 or not np.isfinite(camera_centres).all():
        raise UsageError(f"camera centres of shape {camera_centres.shape} are not finite positions (S, 3) or (S, J, 3)")
    if len(weights.views) and not 0 <= weights.views.min() <= weights.views.max() < len(camera_centres):
        raise UsageError(f"the view weights name a view outside the {len(camera_centres)} given")
