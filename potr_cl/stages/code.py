"""The stage "code": quantise what is left and make the bytes of a file of it, of the kind that is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from potr_cl.codec.container import ENTROPY_CODERS, EntropyCoder
from potr_cl.errors import UsageError
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option


@dataclass(frozen=True)
class Code(Stage):
    """The file itself (:class:`potr_cl.outputs.output.Output`); the last stage, which is always done.

    Attributes:
        entropy, zstd_level: choose the entropy coder (:class:`potr_cl.codec.container.EntropyCoder`).
        gamma, beta, sf_dc, sf_sh, sf_opacity, sf_rotation, sf_scale, block_splats: replace the values that q gives
            (:class:`potr_cl.codec.quantize.HyperParameters`).

    Raises:
        UsageError: a value is out of range.
    """

    name = "code"
    title = "quantiser and coder (each of the steps is set by -q otherwise)"
    needs_views = False

    entropy: str = option(
        EntropyCoder.name,
        Flag(
            "--entropy",
            "bundles: smallest, not for preset paper; zstd: for readers that have nothing but a zstd library",
            choices=ENTROPY_CODERS,
            default="the preset's",
        ),
    )
    zstd_level: int = option(
        EntropyCoder.level, Flag("--zstd-level", "1 (fast) to 22 (small)", "L", int, default="the preset's")
    )
    gamma: float | None = option(
        None, Flag("--gamma", "position precision, in world units", "UNITS", float), parameter=True
    )
    beta: float | None = option(
        None,
        Flag(
            "--beta",
            "position precision relative to the distance of the nearest camera (best, smallest, fast: to the size of a "
            "typical splat)",
            "PART",
            float,
        ),
        parameter=True,
    )
    sf_dc: float | None = option(
        None, Flag("--sf-dc", "quantisation levels per unit for the DC SH coefficients", "SF", float), parameter=True
    )
    sf_sh: float | None = option(
        None, Flag("--sf-sh", "quantisation levels per unit for the other SH coefficients", "SF", float), parameter=True
    )
    sf_opacity: float | None = option(
        None,
        Flag(
            "--sf-opacity",
            "quantisation levels per unit for opacities (best, smallest, fast: for their logits)",
            "SF",
            float,
        ),
        parameter=True,
    )
    sf_rotation: float | None = option(
        None,
        Flag(
            "--sf-rotation",
            "quantisation levels per unit for quaternions (best, smallest, fast: times the root of the largest scale)",
            "SF",
            float,
        ),
        parameter=True,
    )
    sf_scale: float | None = option(
        None,
        Flag(
            "--sf-scale",
            "quantisation levels per unit for scales (best, smallest, fast: per typical splat size, twice as many if "
            "antialiased)",
            "SF",
            float,
        ),
        parameter=True,
    )

    block_splats: float | None = option(
        None,
        Flag(
            "--block-splats",
            "maximum splats per block of a .potr file; 65536 for viewers that show blocks as they arrive",
            "N",
            int,
            default="1048576, in scenes of more than 2097152",
        ),
        parameter=True,
    )

    def __post_init__(self) -> None:
        if not self.on:
            raise UsageError("stage 'code' makes the file: it cannot be left out")
        _ = self.coder

    @property
    def coder(self) -> EntropyCoder:
        """The entropy coder."""
        return EntropyCoder(self.entropy, self.zstd_level)

    @classmethod
    def from_flags(cls, given: dict[str, Any]) -> dict[str, Any]:
        # --zstd-level alone means that coder; --entropy alone means zstd's usual level, not the preset's.
        if given.keys() & {"entropy", "zstd_level"}:
            return {"entropy": "zstd", "zstd_level": EntropyCoder.level, **given}
        return given

    def run(self, state: State, bench: Workbench) -> State:
        """Make the file's bytes, and leave a :class:`potr_cl.codec.encoder.Coded` in ``results``."""
        geometry = state.geometry
        if geometry is not None and geometry.asked != bench.parameters:
            geometry = None
        coded = bench.output.file(state.scene, geometry, bench.request(state, bench.metadata(state), self.coder))
        return state.with_results(coded=coded)
