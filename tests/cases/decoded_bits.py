"""Digests of what files decode to, bit for bit: python -m tests.cases.decoded_bits FILE.potr …

Prints a JSON object: for each file, a SHA-256 of each array. It is run as a program of its own where NumPy has to start
with other vector instructions.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

from potr_cl.codec.decoder import decode


def decoded_bits(path: Path) -> dict[str, str]:
    """SHA-256 of the little-endian float32 of each property of a decoded file."""
    scene = decode(path)
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return {name: hashlib.sha256(getattr(scene, name).astype("<f4").tobytes()).hexdigest() for name in names}


if __name__ == "__main__":
    print(json.dumps({Path(path).stem: decoded_bits(Path(path)) for path in sys.argv[1:]}, indent=1))
