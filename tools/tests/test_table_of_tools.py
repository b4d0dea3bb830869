"""tools/__init__.py says which question each tool answers: none is left out, and none is there that is gone."""

from __future__ import annotations

import re
from pathlib import Path

import tools

ROOT = Path(tools.__file__).parent


def test_every_tool_is_in_the_table():
    listed = re.findall(r"^((?:bench|study|stress|make)\.\w+) ", tools.__doc__, re.MULTILINE)
    programs = {
        f"{path.parent.name}.{path.stem}"
        for folder in ("bench", "study", "stress", "make")
        for path in (ROOT / folder).glob("*.py")
        if 'if __name__ == "__main__"' in path.read_text("utf-8")
    }
    assert len(listed) == len(set(listed))
    assert set(listed) == programs
