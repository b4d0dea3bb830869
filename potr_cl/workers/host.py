"""The devices that a user names, opened (:func:`open_workers`); several of this computer are a :class:`HostPool`, in
which each but the first has a thread of its own.

Drivers leave the interpreter free while they compute, copy or build, so threads are enough.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, choose_devices
from potr_cl.opencl.memory import Owner
from potr_cl.workers.pool import Held, Part, Pool, Traffic, Worker, tell_of_kinds

if TYPE_CHECKING:
    from dask.distributed import Client


class HostPool(Pool):
    """Several devices of this computer.

    Args:
        devices: opened; the master computes on the first one too.

    Raises:
        UsageError: there is no device, or they run different kernels, which round differently.
    """

    in_process = True

    def __init__(self, devices: Sequence[Device]) -> None:
        if not devices:
            raise UsageError("no device to share the work out to")
        for device in devices:
            if device.family != devices[0].family:
                raise UsageError(
                    f"devices {devices[0].info} and {device.info} run different kernels, which round differently: "
                    "choose devices of one kind"
                )
        self.first = devices[0]
        tell_of_kinds(str(self.first.info), (str(device.info) for device in devices))
        self.traffic = Traffic()
        self._devices = tuple(devices[1:])
        self._workers = [DeviceThread(device, number) for number, device in enumerate(devices[1:], 1)]
        # The first device may have room where another one has not.
        self._reserve = DeviceThread(devices[0], 0)

    def workers(self) -> list[Worker]:
        return list(self._workers)

    @property
    def devices(self) -> Sequence[Device]:
        return self._devices

    def reserve(self) -> list[Worker]:
        return [self._reserve]

    @property
    def names(self) -> tuple[str, ...]:
        return (f"0: {self.first.info}", *(worker.name for worker in self._workers))

    def close(self) -> None:
        for worker in [*self._workers, self._reserve]:
            worker.close()


class DeviceThread(Worker):
    """A thread that computes on a device."""

    def __init__(self, device: Device, number: int) -> None:
        self.name = f"{number}: {device.info}"
        self._device = device
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"potr_cl device {number}")

    def make(self, kind: type[Part], memory: int | None, given: Sequence[Any]) -> Future[Held]:
        def made() -> Held:
            part = kind.made(self._device, memory, given)
            return _HeldHere(self._thread, threading.get_ident(), self._device, part)

        return self._thread.submit(made)

    def close(self) -> None:
        self._thread.shutdown(wait=True, cancel_futures=True)


class _HeldHere(Held):
    """A part in this process."""

    def __init__(self, thread: ThreadPoolExecutor, ident: int, device: Device, part: Part) -> None:
        self._thread, self._ident, self._device, self._part = thread, ident, device, part

    def begin(self, command: str, args: Sequence[Any]) -> Future[Any]:
        return self._thread.submit(self._part.told, self._device, command, args)

    def close(self) -> None:
        if threading.get_ident() == self._ident:  # it has just been made there, and nobody wants it any more
            self._part.close()
        else:
            self._thread.submit(self._part.close).result()


#: A device, what it is called, or several: "all", "0,1", or a list.
DevicesSource: TypeAlias = "Device | DeviceInfo | str | Sequence[Device | DeviceInfo | str] | None"
#: The address of a Dask scheduler, or a client of it.
ClusterSource: TypeAlias = "str | Client | None"


@dataclass(frozen=True)
class Workers(Owner):
    """What computes.

    Attributes:
        pool: where there is more than one device; else None.
    """

    device: Device
    pool: Pool | None = None

    @property
    def devices(self) -> Sequence[Device]:
        """All devices of this process, the first one first."""
        return (self.device, *(self.pool.devices if self.pool is not None else ()))

    def close(self) -> None:
        """Leave the workers."""
        if self.pool is not None:
            self.pool.close()


def open_workers(devices: DevicesSource = None, cluster: ClusterSource = None) -> Workers:
    """Open one device, several of this computer, or one and a cluster.

    Args:
        devices: None: the device that should be fastest.
        cluster: whose workers compute; the device of this computer then only adds up what they find. None: no cluster.

    Raises:
        UsageError: a device is named twice, several devices and a cluster are named, or the cluster cannot be used.
        DeviceError: a device is missing, or does not work.
    """
    named = [devices] if devices is None or isinstance(devices, (Device, DeviceInfo, str)) else list(devices)
    if not named:
        raise UsageError("the list of devices is empty: leave it out, and the fastest one is taken")
    chosen: list[Device | DeviceInfo] = []
    for each in named:
        chosen += choose_devices(each) if each is None or isinstance(each, str) else [each]
    handles = [(each.info if isinstance(each, Device) else each).handle for each in chosen]
    twice = [handle for handle in handles if handles.count(handle) > 1]
    if twice and not all(isinstance(each, Device) for each in chosen):
        raise UsageError(f"device '{twice[0].name.strip()}' is named twice: name each device once")
    if cluster is not None and len(chosen) > 1:
        raise UsageError("several devices and a cluster are named: a cluster's workers have their devices themselves")
    with ThreadPoolExecutor(len(chosen)) as threads:  # drivers take long to open one
        opened = list(threads.map(lambda each: each if isinstance(each, Device) else Device(each), chosen))
    if cluster is not None:
        from potr_cl.workers.cluster import ClusterPool  # Dask is not installed everywhere

        return Workers(opened[0], ClusterPool(cluster, opened[0]))
    return Workers(opened[0], HostPool(opened) if len(opened) > 1 else None)
