"""A client of a Dask cluster: :func:`client_of`."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from potr_cl.errors import UsageError
from potr_cl.host.libraries import install_command

if TYPE_CHECKING:
    from dask.distributed import Client

#: Seconds to wait for a scheduler.
_CONNECT = 5.0


def client_of(cluster: str | Client) -> tuple[Client, bool]:
    """A client, and whether it was made here: then it goes to the workers itself, and not by way of the scheduler.

    Args:
        cluster: the scheduler's address, or a client.

    Raises:
        UsageError: Dask is not installed, it is neither, or no scheduler answers there.
    """
    try:
        from dask.distributed import Client
    except ImportError:
        raise UsageError(f"a cluster needs Dask: {install_command('cluster')}") from None
    if isinstance(cluster, Client):
        return cluster, False
    if not isinstance(cluster, str):
        raise UsageError(
            f"a cluster is the address of a Dask scheduler, or a dask.distributed.Client, not {type(cluster).__name__}"
        )
    if not cluster.strip():
        raise UsageError("--cluster is empty: give the address of a Dask scheduler, such as tcp://10.0.0.1:8786")
    # What it has to say is said here, in one line. Some of its modules' loggers have levels of their own.
    for name in ["distributed", *(name for name in logging.root.manager.loggerDict if name.startswith("distributed."))]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        return Client(cluster, timeout=_CONNECT, set_as_default=False, direct_to_workers=True), True
    except Exception as error:
        # Of another program's answer it takes the first bytes for a size.
        said = "something else does" if isinstance(error, MemoryError) else first_line(error)
        raise UsageError(
            f"no Dask scheduler answers at '{cluster}' ({said}): give its address, such as tcp://10.0.0.1:8786"
        ) from None


def first_line(error: BaseException) -> str:
    """What an error says, in one line that is not long."""
    said = str(error).strip().partition("\n")[0][:200]
    return said or type(error).__name__
