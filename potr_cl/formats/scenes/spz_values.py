"""What the bytes of an SPZ file stand for, in both directions: :func:`unpacked` and :func:`packed`.

Positions are integers of 24 bits, all else is bytes: opacities after the sigmoid, logarithms of scales, rotations
without the part that follows from the others, colours, and SH coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import canonical_rotations
from potr_cl.formats.scenes.scene_files import byte_logits, with_largest
from potr_cl.model.scene import FloatArray, Scene

#: The version whose positions are half floats.
HALF_FLOATS = 1
#: Positions are integers of 24 bits with a sign.
POSITION_LIMIT = 2**23 - 1
MOST_FRACTIONAL_BITS = 24
_COLOUR_SCALE = 0.15
#: Of a quaternion's three smallest parts: 9 bits of magnitude below a sign, for 0 to √½.
_LARGEST_PART = 511
#: Which parts of x, y, z, w are stored, first the lowest bits, by the number of the largest, which is not.
_STORED_PARTS = np.array([[3, 2, 1], [3, 2, 0], [3, 1, 0], [2, 1, 0]])
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16

U8 = NDArray[np.uint8]


def unpacked(
    properties: Sequence[bytes | memoryview], count: int, coefficients: int, version: int, fractional_bits: int
) -> Scene:
    """The values of a file's bytes, block by block.

    Args:
        properties: positions, opacities, colours, scales, rotations and SH, each for all splats in turn.
        count: of splats.
        coefficients: of SH that are wanted, with the constant one; there may be more in the file.
        version, fractional_bits: of the file.
    """
    positions, opacities, colours, scales, rotations, rest = (
        np.frombuffer(part, np.uint8).reshape(count, -1) for part in properties
    )
    scene = Scene.blank(count, coefficients, by_splat=True)
    byte, logits = np.arange(256).astype(np.float32), byte_logits()
    dc = (byte / np.float32(255) - np.float32(0.5)) / np.float32(_COLOUR_SCALE)
    for start in range(0, count, _BLOCK):
        block = slice(start, start + _BLOCK)
        scene.means[block] = _positions(positions[block], version, fractional_bits)
        scene.log_scales[block] = (byte / 16 - 10).take(scales[block])
        scene.quaternions[block] = _smallest_three(rotations[block]) if version > 2 else _xyz(rotations[block])
        scene.opacity_logits[block] = logits.take(opacities[block, 0])
        scene.sh[block, 0] = dc.take(colours[block])
        if coefficients > 1:
            stored = rest[block, : 3 * (coefficients - 1)]
            scene.sh[block, 1:] = ((byte - 128) / 128).take(stored).reshape(-1, coefficients - 1, 3)
    return scene


def _positions(stored: U8, version: int, fractional_bits: int) -> FloatArray:
    if version == HALF_FLOATS:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float32)
    parts = stored.reshape(-1, 3, 3).astype(np.int32)
    values = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    values = (values ^ 0x800000) - 0x800000
    positions: FloatArray = values.astype(np.float32) * np.float32(2.0**-fractional_bits)
    return positions


def _smallest_three(stored: U8) -> FloatArray:
    """Quaternions w, x, y, z from the number of the largest part and the three others."""
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0]
    largest = (packed >> 30).astype(np.intp)
    part = np.arange(1024)
    magnitudes = np.float32(np.sqrt(0.5)) * ((part & _LARGEST_PART) / np.float32(_LARGEST_PART)).astype(np.float32)
    values = np.where(part > _LARGEST_PART, -magnitudes, magnitudes)
    others = np.stack([values.take((packed >> shift) & 1023) for shift in (0, 10, 20)], axis=1)
    return with_largest(largest, others, _STORED_PARTS)[:, [3, 0, 1, 2]]


def _xyz(stored: U8) -> FloatArray:
    """Quaternions w, x, y, z from bytes of x, y, z, as versions 1 and 2 have them."""
    xyz = stored.astype(np.float32) / np.float32(127.5) - np.float32(1)
    left = 1 - (xyz * xyz).sum(axis=1)
    return np.column_stack([np.sqrt(np.maximum(left, 0)), xyz])


def packed(scene: Scene, fractional_bits: int, version: int) -> list[bytes]:
    """The bytes of a scene with unit quaternions, property by property, as :func:`unpacked` takes them."""
    if version == 2:
        scene = _well_conditioned(scene)

    def as_bytes(values: NDArray[Any]) -> bytes:
        return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()

    with np.errstate(over="ignore"):  # of values far beyond what bytes hold
        steps = np.round(scene.means * np.float32(2**fractional_bits)).astype(np.int64)
        fixed = np.clip(steps, -POSITION_LIMIT - 1, POSITION_LIMIT).astype("<i4")
        return [
            np.ascontiguousarray(fixed.view(np.uint8).reshape(len(scene), 3, 4)[..., :3]).tobytes(),
            as_bytes(255 / (1 + np.exp(-scene.opacity_logits))),
            as_bytes(scene.sh[:, 0] * np.float32(_COLOUR_SCALE * 255) + np.float32(127.5)),
            as_bytes((scene.log_scales + np.float32(10)) * np.float32(16)),
            _packed_rotations(scene.quaternions) if version > 2 else as_bytes(_first_three(scene.quaternions)),
            as_bytes(scene.sh[:, 1:] * np.float32(128) + np.float32(128)),
        ]


def _well_conditioned(scene: Scene) -> Scene:
    """The same splats with their axes numbered such that w, which version 2 leaves to the reader, is the largest part.

    A reader takes w from the squares of the others: where it is small, their rounding would turn the splat by degrees.
    """
    imaginary, log_scales = canonical_rotations(scene.quaternions, scene.log_scales)
    real = np.sqrt(np.maximum(1 - (imaginary * imaginary).sum(axis=1), 0))
    quaternions = np.column_stack([real, imaginary]).astype(np.float32)
    return replace(scene, quaternions=quaternions, log_scales=log_scales)


def _first_three(quaternions: FloatArray) -> NDArray[Any]:
    """x, y and z of unit quaternions with w >= 0, from 0 to 255: a reader takes w from the others."""
    signs = np.where(quaternions[:, :1] < 0, np.float32(-1), np.float32(1))
    parts: NDArray[Any] = (quaternions[:, 1:] * signs + np.float32(1)) * np.float32(127.5)
    return parts


def _packed_rotations(quaternions: FloatArray) -> bytes:
    xyzw = quaternions[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw[np.take_along_axis(xyzw, largest[:, None], axis=1)[:, 0] < 0] *= -1
    others = np.take_along_axis(xyzw, _STORED_PARTS[largest], axis=1)
    parts = np.minimum(np.round(np.abs(others) * (_LARGEST_PART / np.sqrt(0.5))), _LARGEST_PART).astype(np.uint32)
    parts |= (others < 0).astype(np.uint32) << 9
    packed = parts[:, 0] | parts[:, 1] << 10 | parts[:, 2] << 20 | largest.astype(np.uint32) << 30
    stored: bytes = packed.astype("<u4").tobytes()
    return stored
