"""What headers of all versions promise: their own size, the file's, and a checksum (:func:`require_sound_header`)."""

from __future__ import annotations

import struct
import zlib

from potr_cl.errors import DataError

#: CRC-32 of all that stands before it, the last thing of a header.
CRC = struct.Struct("<I")


def require_sound_header(
    data: bytes | memoryview, header_bytes: int, counted: int, parts: str, said_bytes: int, file_bytes: int
) -> None:
    """Check a header's sizes and its checksum.

    Args:
        data: the first bytes of the file.
        header_bytes: the header's size, as it says itself.
        counted: the same, as the number of its parts has it.
        parts: what these are called.
        said_bytes: the file's size, as the header says.
        file_bytes: the file's real size.

    Raises:
        DataError: they disagree, bytes are missing, or the checksum is another.
    """
    if header_bytes != counted:
        raise DataError(f"the header is damaged (its size does not fit its number of {parts}): get the file again")
    if len(data) < header_bytes:
        raise DataError(f"truncated: the header has {header_bytes} bytes, the file {file_bytes}")
    if zlib.crc32(data[: header_bytes - CRC.size]) != CRC.unpack_from(data, header_bytes - CRC.size)[0]:
        raise DataError("the header is damaged (its checksum does not match): get the file again")
    if said_bytes != file_bytes:
        how = "truncated" if file_bytes < said_bytes else "followed by something else"
        raise DataError(f"{how}: the file has {file_bytes} bytes, its header says {said_bytes}")
