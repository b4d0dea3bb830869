"""What sections hold: :class:`Property`, by the name in the file; and a table entry, :class:`Section`."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Property(enum.Enum):
    """What a section holds, in the order in which sections stand. A reader may skip those that begin in lower case."""

    OCCUPANCY = "OCCU"
    SEVERAL = "SEVE"
    MULTIPLICITY = "MULT"
    LEAF_LEVEL = "LEAF"
    TAIL = "TAIL"
    STEPS = "STEP"
    OPACITY = "OPAC"
    SCALE = "SCAL"
    ROTATION = "ROTA"
    SH0 = "SHC0"
    SH1 = "SHC1"
    SH2 = "SHC2"
    SH3 = "SHC3"
    METADATA = "meta"

    @property
    def degree(self) -> int | None:
        """Of the SH coefficients in it; None: it holds none."""
        return SH.index(self) if self in SH else None

    @property
    def streams(self) -> int:
        """How many integers it holds of each splat; 0: it does not hold the same of each."""
        if self in SH:
            return 3 * (2 * SH.index(self) + 1)
        return {Property.OPACITY: 1, Property.SCALE: 3, Property.ROTATION: 3}.get(self, 0)

    @property
    def signed(self) -> bool:
        """Whether its integers can be negative, and so are zig-zag mapped."""
        return self is Property.ROTATION or self in SH

    @property
    def title(self) -> str:
        """For messages and tables."""
        return self.name.lower().replace("_", " ")


#: The sections of SH coefficients, by degree.
SH = (Property.SH0, Property.SH1, Property.SH2, Property.SH3)
#: All sections of a block, in their order.
ORDER = tuple(prop for prop in Property if prop is not Property.METADATA)


class Coder(enum.IntEnum):
    """How a block's integers of splats are coded."""

    PLAIN = 0
    BUNDLES = 1


@dataclass(frozen=True)
class Section:
    """One entry of a table.

    Attributes:
        name: four letters or digits.
        stored_bytes: its size in the file.
        raw_bytes: size of its content; the same if it is stored as it is, else it is a zstd frame.
        crc: CRC-32 of the stored bytes.
        offset: of the stored bytes, from the first byte of the block, or of the file's own sections.
    """

    name: str
    stored_bytes: int
    raw_bytes: int
    crc: int
    offset: int = 0

    @property
    def kind(self) -> Property | None:
        """None: not known to this version of the package, which may skip it."""
        return _BY_NAME.get(self.name)

    @property
    def required(self) -> bool:
        """Whether a reader that does not know it must refuse the file."""
        return self.name[0].isupper()

    @property
    def title(self) -> str:
        return self.kind.title if self.kind else self.name


_BY_NAME = {prop.value: prop for prop in Property}
