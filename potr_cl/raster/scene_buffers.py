"""A scene's splats on a device, as the projection takes them (:class:`SceneBuffers`), and how they come there."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceError
from potr_cl.host.threads import Ahead
from potr_cl.model.scene import LOW_PASS, SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.opencl import sending
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.raster.activation import activated_scales, log2_opacities, unit_quaternions

#: Splats are padded to a multiple of this and handled in work-groups of it. CPUs are told the work-group too: left to
#: itself, PoCL makes one of thousands and overflows its stack with their private memory.
SPLAT_GROUP = 256

#: Splats whose parameters are uploaded at a time.
_UPLOADED = 1 << 18
#: Splats that are copied out of a scene at a time: so few that no array of theirs is ever mapped to a file.
_TAKEN = 1 << 16
#: Splats whose parameters are activated at a time.
_ACTIVATED = 1 << 17


class SceneBuffers(Owner):
    """A scene's parameters in a device's memory, activated, for a :class:`~potr_cl.raster.rasterizer.Rasterizer`.

    Every parameter is an array of float32 columns, (columns, stride), a column a value of every splat:
    cl/raster/project.cl says how they are used. :func:`uploaded` makes one of a scene,
    :func:`potr_cl.decode_to_device` of a file.

    Args:
        device: to hold them.
        splats: N.
        sh_count: M, SH coefficients of a colour channel.
        antialiased, low_pass: as of :class:`potr_cl.model.scene.Scene`.
        memory: owns the buffers, somebody else's; None: their own.

    Attributes:
        device, splats, sh_count, antialiased, low_pass: as given.
        stride: N rounded up; what lies beyond the N-th splat is not drawn.
        means: (3, stride) centres in world units.
        scales: (3, stride) standard deviations in world units.
        quaternions: (4, stride) unit quaternions w, x, y, z.
        log2_opacities: (1, stride) logarithms to base 2 of the opacities.
        sh: (3 M, stride) SH coefficients: R, G, B of the first, of the second, …

    Raises:
        DeviceError: the scene does not fit the device.
    """

    def __init__(
        self, device: Device, splats: int, sh_count: int, antialiased: bool = False, low_pass: float = LOW_PASS,
        memory: Memory | None = None,
    ) -> None:  # fmt: skip
        if splats > 0xFFFFFF00:
            raise DeviceError(f"{splats} splats are more than the kernels can number")
        self.device = device
        self.splats = splats
        self.stride = stride_of(splats)
        self.sh_count = sh_count
        self.antialiased, self.low_pass = antialiased, low_pass
        self._memory = memory or Memory(device)
        self.wake()

    def wake(self) -> None:
        """Take the memory again that :meth:`rest` has given back; the splats have to be written anew.

        Raises:
            DeviceError: the scene does not fit the device.
        """
        try:
            self.means = self._columns(3, 0, "the centres")
            self.scales = self._columns(3, 0, "the scales")
            self.quaternions = self._columns(4, 0, "the rotations")
            # The padding has an opacity of 0: it is not drawn.
            self.log2_opacities = self._columns(1, -np.inf, "the opacities")
            self.sh = self._columns(3 * self.sh_count, 0, "the SH coefficients")
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return self.splats

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_COEFFICIENTS.index(self.sh_count)

    @property
    def nbytes(self) -> int:
        """Bytes of all buffers."""
        return self._memory.nbytes

    @property
    def parameters(self) -> dict[str, cl.Buffer]:
        """All parameters by their names; of devices of all kinds they have the same size."""
        return {name: getattr(self, name) for name in self._widths}

    @property
    def _widths(self) -> dict[str, int]:
        """Columns of each parameter."""
        return {"means": 3, "scales": 3, "quaternions": 4, "log2_opacities": 1, "sh": 3 * self.sh_count}

    @property
    def geometry(self) -> dict[str, Any]:
        """All parameters but the SH coefficients, and the stride, by the names that the projection's arguments have."""
        return {
            "stride": self.stride,
            "means": self.means,
            "scales": self.scales,
            "quaternions": self.quaternions,
            "log2_opacities": self.log2_opacities,
        }

    @property
    def pick_macros(self) -> dict[str, int]:
        """Macros of the projection that follow from which splats of the buffers are this scene's: here all are."""
        return {}

    @property
    def picks(self) -> dict[str, Any]:
        """The projection's arguments that say which they are, by their names."""
        return {"whole_stride": self.stride, "numbers": self.means, "picked": self.splats, "apart": 0}

    def read_back(self, rows: NDArray[np.int64]) -> Scene:
        """Some splats as a scene on the host again: (n,) numbers. Logarithms and logits are rounded once more."""

        def read(parameter: cl.Buffer, columns: int) -> NDArray[np.float32]:
            starts = range(0, 4 * self.stride * columns, 4 * self.stride)
            found = [self.device.download(parameter, (self.splats,), np.float32, start)[rows] for start in starts]
            return np.stack(found, axis=1)

        logarithms = np.maximum(read(self.log2_opacities, 1)[:, 0].astype(np.float64), -100) * np.log(2)
        below_one = np.maximum(-np.expm1(logarithms), 2.0**-30)
        return Scene(
            read(self.means, 3),
            np.log(np.maximum(read(self.scales, 3), np.finfo(np.float32).tiny)),
            read(self.quaternions, 4),
            (logarithms - np.log(below_one)).astype(np.float32),
            read(self.sh, 3 * self.sh_count).reshape(len(rows), self.sh_count, 3),
            self.antialiased,
            self.low_pass,
        )

    def write_rows(
        self,
        parameter: cl.Buffer,
        rows: NDArray[Any],
        what: str,
        pending: list[cl.Event] | None = None,
        start: int = 0,
        room: cl.Buffer | None = None,
    ) -> None:
        """Set a parameter to rows, one for each splat, which are turned to columns on the device.

        Args:
            parameter: one of the buffers.
            rows: (n, columns) of any kind of float.
            what: they are, for errors.
            pending: as of :meth:`potr_cl.opencl.device.Device.upload`.
            start: number of the first of these splats.
            room: on the device for all rows, float32; None: it is taken, which drivers may have wait for what else they
                do.

        Raises:
            DeviceError: there is no room for them beside the scene.
        """
        device, width = self.device, rows.shape[1]
        turn = device.shared_kernel("raster/columns.cl", "columns")
        if start + len(rows) > self.splats:
            raise ValueError(f"{len(rows)} rows from splat {start} on do not fit {self.splats} splats")
        if pending is None and rows.nbytes >= sending.LEAST and not device.info.shares_host_memory:
            height = max(sending.PIECE // (4 * width), 1)
            firsts = range(0, len(rows), height)
            with sending.Sending(device, what) as sender:
                pieces = sender.pieces([rows[first : first + height] for first in firsts])
                for first, sent in zip(firsts, pieces, strict=True):
                    turn.bind(rows=sent, first=start + first, width=width, stride=self.stride, result=parameter)
                    turn.launch((min(height, len(rows) - first),))
            return
        with Memory(device) as memory:
            if room is None:
                room = memory.allocate(4 * width * min(len(rows), _UPLOADED), what)
            for first in range(0, len(rows), _UPLOADED):
                some = np.ascontiguousarray(rows[first : first + _UPLOADED], np.float32)
                with device.errors(f"cannot hold {what}"):
                    event = cl.enqueue_copy(device.queue, room, some, is_blocking=pending is None)
                if pending is not None:
                    pending.append(event)
                turn.bind(rows=room, first=start + first, width=width, stride=self.stride, result=parameter)
                turn.launch((len(some),))

    def write_part(self, part: SceneBuffers, first: int) -> None:
        """Set the parameters of some splats to those of another scene on the same device.

        Args:
            part: of the same SH degree.
            first: the number here of its first splat.

        Raises:
            DeviceError: the device failed.
        """
        if first + part.splats > self.splats or part.sh_count != self.sh_count:
            raise ValueError(f"{part.splats} splats from number {first} on do not fit {self.splats} splats")
        with self.device.errors("cannot take a part of a scene"):
            for name, columns in self._widths.items():
                cl.enqueue_copy(
                    self.device.queue,
                    getattr(self, name),
                    getattr(part, name),
                    src_origin=(0, 0, 0),
                    dst_origin=(4 * first, 0, 0),
                    region=(4 * part.splats, columns, 1),
                    src_pitches=(4 * part.stride, 0),
                    dst_pitches=(4 * self.stride, 0),
                )
            self.device.queue.finish()

    def gather(self, scene: SceneBuffers, splats: NDArray[np.int64]) -> None:
        """Take all parameters from another scene on the same device.

        Args:
            scene: of the same SH degree.
            splats: (N,) the numbers there of these splats.

        Raises:
            DeviceError: there is no room for the numbers, or the device failed.
        """
        device = self.device
        gather = device.shared_kernel("raster/gather_columns.cl", "gather_columns")
        with Memory(device) as memory:
            numbers = memory.upload(splats.astype(np.uint32), "the numbers of some splats")
            for name, count in self._widths.items():
                gather.bind(
                    columns=getattr(scene, name),
                    stride=scene.stride,
                    numbers=numbers,
                    count=self.splats,
                    result_stride=self.stride,
                    result=getattr(self, name),
                )
                gather.launch((self.stride, count), (SPLAT_GROUP, 1))
            with device.errors("cannot take a part of a scene"):
                device.queue.finish()

    def write(self, scene: Scene, colours: bool = True) -> None:
        """Set all parameters to those of a scene of the host, of the same SH degree.

        Args:
            scene: the scene.
            colours: whether to set its colours too.

        Raises:
            DeviceError: there is no room for them beside the scene.
        """

        def activated(start: int) -> list[FloatArray]:
            """What is activated is there for some splats at a time: of all it would be as large as their geometry."""
            some = slice(start, start + _ACTIVATED)
            return [
                activated_scales(scene.log_scales[some]).astype(np.float32),
                unit_quaternions(scene.quaternions[some]).astype(np.float32),
                log2_opacities(scene.opacity_logits[some])[:, None].astype(np.float32),
            ]

        parameters = (
            (self.scales, "the scales"),
            (self.quaternions, "the rotations"),
            (self.log2_opacities, "the opacities"),
        )
        # While threads activate the first splats, the others' own values are sent.
        with Memory(self.device) as memory, Ahead(activated, range(0, self.splats, _ACTIVATED)) as made:
            room = memory.allocate(16 * min(self.splats, _ACTIVATED), "a scene's parameters")
            self.write_rows(self.means, scene.means, "the centres")
            if colours:
                self.write_sh(self.sh, scene.sh)
            for start, found in made:
                for (parameter, what), rows in zip(parameters, found, strict=True):
                    self.write_rows(parameter, rows, what, start=start, room=room)

    def write_some(self, scene: Scene, splats: NDArray[np.int64]) -> None:
        """Set all parameters to those of some splats of a scene of the host, which are copied a few at a time.

        Args:
            scene: of the same SH degree.
            splats: (N,) the numbers there of these splats.

        Raises:
            DeviceError: there is no room for some of them beside the scene.
        """

        def taken(start: int) -> list[tuple[cl.Buffer, FloatArray, str]]:
            some = scene.subset(splats[start : start + _TAKEN])
            return [
                (self.means, some.means, "the centres"),
                (self.scales, activated_scales(some.log_scales).astype(np.float32), "the scales"),
                (self.quaternions, unit_quaternions(some.quaternions).astype(np.float32), "the rotations"),
                (self.log2_opacities, log2_opacities(some.opacity_logits)[:, None].astype(np.float32), "the opacities"),
                (self.sh, some.sh.reshape(len(some), -1), "the SH coefficients"),
            ]

        with Memory(self.device) as memory, Ahead(taken, range(0, self.splats, _TAKEN)) as made:
            widest = max(3 * self.sh_count, 4)  # of rotations
            room = memory.allocate(4 * widest * min(self.splats, _TAKEN), "a scene's parameters")
            for start, found in made:
                for parameter, rows, what in found:
                    self.write_rows(parameter, rows, what, start=start, room=room)

    def write_sh_of(self, sh: FloatArray, splats: NDArray[np.int64]) -> None:
        """Set the SH coefficients to those of some splats, (n, M, 3) float32 of any strides; ``splats``: (N,)."""
        for start in range(0, len(splats), _TAKEN):
            rows = sh[splats[start : start + _TAKEN]].reshape(-1, 3 * self.sh_count)
            self.write_rows(self.sh, rows, "the SH coefficients", start=start)

    def write_sh(self, parameter: cl.Buffer, sh: FloatArray) -> None:
        """Set SH coefficients, (N, M, 3) float32 of any strides.

        Args:
            parameter: ``sh``, or a buffer of :meth:`other_sh`.
            sh: the coefficients.
        """
        planar = sh.transpose(1, 2, 0)
        if planar.flags.c_contiguous and planar.dtype == np.float32:  # as a decoder leaves them
            with self.device.errors("cannot take a scene"):
                cl.enqueue_copy(
                    self.device.queue,
                    parameter,
                    planar,
                    buffer_origin=(0, 0, 0),
                    host_origin=(0, 0, 0),
                    region=(4 * self.splats, 3 * self.sh_count, 1),
                    buffer_pitches=(4 * self.stride, 0),
                    host_pitches=(4 * self.splats, 0),
                    is_blocking=True,
                )
        else:
            self.write_rows(parameter, sh.reshape(self.splats, -1), "the SH coefficients")

    def other_sh(self, memory: Memory, sh: FloatArray) -> cl.Buffer:
        """Other SH coefficients for the same splats, (N, M, 3) float32 of the same degree, in a buffer like ``sh``.

        Args:
            memory: that owns the buffer.
            sh: the coefficients.
        """
        buffer = self._columns(3 * self.sh_count, 0, "the SH coefficients", memory)
        self.write_sh(buffer, sh)
        return buffer

    def release_sh(self) -> cl.Buffer:
        """The buffer ``sh``, which is the caller's to free from now on."""
        return self._memory.release(self.sh)

    def _columns(self, number: int, value: float, what: str, memory: Memory | None = None) -> cl.Buffer:
        buffer = (memory or self._memory).allocate(4 * number * self.stride, what)
        self.device.fill(buffer, np.float32(value))
        return buffer

    def rest(self) -> None:
        """Give the memory back until :meth:`wake`."""
        self.close()

    @property
    def rests(self) -> bool:
        """Whether there is no memory now."""
        return not self._memory.nbytes


def stride_of(splats: int) -> int:
    """So many splats rounded up: how long a column of values is that has one for each."""
    return max(-(-splats // SPLAT_GROUP), 1) * SPLAT_GROUP


#: What can be rendered: a scene of the host, or one that is on the device already.
Drawable: TypeAlias = "Scene | SceneBuffers"


def gathered(scene: SceneBuffers, splats: NDArray[np.int64]) -> SceneBuffers:
    """Some splats of a scene on a device, there.

    Args:
        scene: that has them.
        splats: (n,) their numbers.

    Raises:
        DeviceError: they do not fit the device beside the scene.
    """
    with scene.device.all_or_nothing():
        part = SceneBuffers(scene.device, len(splats), scene.sh_count, scene.antialiased, scene.low_pass)
        part.gather(scene, splats)
    return part


def uploaded(device: Device, scene: Scene) -> SceneBuffers:
    """A scene's parameters on a device: copied, later changes of its arrays are not seen.

    Raises:
        DeviceError: the scene does not fit the device.
    """
    with device.all_or_nothing():
        buffers = SceneBuffers(device, len(scene), scene.sh.shape[1], scene.antialiased, scene.low_pass)
        colours = bool(scene.sh[:_TAKEN].any() or scene.sh.any())  # new ones are black
        buffers.write(scene, colours)
    return buffers


def copied(device: Device, scene: SceneBuffers) -> SceneBuffers:
    """The same parameters on another device of this process.

    Raises:
        DeviceError: the scene does not fit the device, or one of the two failed.
    """
    with device.all_or_nothing():
        buffers = SceneBuffers(device, scene.splats, scene.sh_count, scene.antialiased, scene.low_pass)
        with Relay(device) as relay:
            for name, its in scene.parameters.items():
                relay.fetch(buffers.parameters[name], Lent(scene.device, its, its.size))
    return buffers
