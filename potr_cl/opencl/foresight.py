"""Which programs a purpose has needed before, so that they can be loaded while others still work: :class:`Foresight`.

To load a built program takes a driver and pyopencl some milliseconds, and an encode takes about twenty programs. They
are noted beside the programs themselves, for each purpose, device and driver. A note that is missing, damaged or of
another version costs nothing but the time that it would have spared.
"""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import suppress
from pathlib import Path

from potr_cl.errors import PotrError
from potr_cl.host.atomic_write import replacing

#: A program: the file of its source, and its macros.
Wanted = tuple[str, tuple[tuple[str, str], ...]]

#: More are not noted: those of the latest encodes are among the first.
_MOST = 64


class Foresight:
    """The programs that were needed for a purpose.

    Args:
        folder: of the notes.
        purpose: what for, on which device and with which driver.

    Attributes:
        programs: in the order in which they were asked for.
    """

    def __init__(self, folder: Path, purpose: str) -> None:
        self._path = folder / f"needed-{hashlib.sha256(purpose.encode()).hexdigest()[:24]}.json"
        self.programs: list[Wanted] = []
        with suppress(OSError, ValueError, TypeError, KeyError):
            for source, macros in json.loads(self._path.read_text("utf-8"))[:_MOST]:
                if re.fullmatch(r"\w+/\w+\.cl", source):
                    self.programs.append((source, tuple((str(name), str(value)) for name, value in macros)))

    def note(self, program: Wanted) -> None:
        """Note that a program was needed."""
        if program in self.programs or len(self.programs) >= _MOST:
            return
        self.programs.append(program)
        with suppress(OSError, PotrError), replacing(self._path) as file:
            file.write(json.dumps(self.programs).encode())
