"""The devices that a user names, opened: :func:`open_workers`."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, TypeAlias

from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, choose_devices
from potr_cl.workers.host import HostPool
from potr_cl.workers.pool import Pool

if TYPE_CHECKING:
    from dask.distributed import Client

#: A device, what it is called, or several: "all", "0,1", or a list.
DevicesSource: TypeAlias = "Device | DeviceInfo | str | Sequence[Device | DeviceInfo | str] | None"
#: The address of a Dask scheduler, or a client of it.
ClusterSource: TypeAlias = "str | Client | None"


@dataclass(frozen=True)
class Workers(AbstractContextManager["Workers"]):
    """What computes.

    Attributes:
        device: the first device.
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


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
