"""What tests of the browser's decoder (web/) compare it with."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.errors import DataError

ROOT = Path(__file__).parents[2]
WEB = ROOT / "web"
GOLDEN = sorted((ROOT / "tests" / "data").glob("golden_*.potr"))


def judged(data: bytes) -> str:
    """What becomes of a file: the words of its refusal, or the SHA-256 of its arrays."""
    try:
        scene = decode(data)
    except DataError as error:
        return str(error)
    digest = hashlib.sha256()
    for array in (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
