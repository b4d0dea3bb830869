"""Temporary files of which users are told by another name (:func:`called`): what they gave is not that file."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from potr_cl.errors import PotrError


@contextlib.contextmanager
def called(written: str, known: str) -> Iterator[None]:
    """Of a block in which something is called by another name in errors of ours and in the log "potr_cl".

    Blocks may stand in each other: what the inner one says is told as the outer one calls it.

    Args:
        written: as readers and writers call it.
        known: as users know it.
    """

    class Renamed(logging.Filter):
        def filter(self, record: logging.LogRecord) -> bool:
            record.msg, record.args = record.getMessage().replace(written, known), None
            return True

    log, renamed = logging.getLogger("potr_cl"), Renamed()
    log.filters.insert(0, renamed)  # before the outer blocks' filters, which rename what comes out of this one
    try:
        yield
    except PotrError as error:
        if written not in str(error):
            raise
        raise type(error)(str(error).replace(written, known)) from error
    finally:
        log.removeFilter(renamed)
