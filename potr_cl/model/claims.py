"""How many splats a file may claim to hold, judged by its size before anything of it is unpacked.

A few kilobytes can be a lossless description of a billion equal splats. No scene is like that, so a reader that takes
memory in proportion to a file refuses such a claim, unless its user vouches for the file.
"""

from __future__ import annotations

from potr_cl.errors import DataError

#: Any file may hold so many: the memory that they take is nothing to worry about.
FREE_SPLATS = 1 << 16


def check_claim(number: int, file_bytes: int, most_a_byte: int, trust: bool, what: str = "splats") -> None:
    """Refuse a number that no real scene would pack into so small a file.

    Args:
        number: that the file claims.
        file_bytes: size of the file.
        most_a_byte: the largest believable number in a byte of the format.
        trust: whether the user vouches for the file, so that nothing is refused.
        what: is counted, for the message.

    Raises:
        DataError: the claim is beyond belief.
    """
    if not trust and number > FREE_SPLATS + most_a_byte * file_bytes:
        raise DataError(
            f"{number} {what} in {file_bytes} bytes are more than a real scene packs into them, and could fill the "
            "memory: if you know where the file comes from, read it with --trust (in Python: trust=True)"
        )
