"""How to encode: every choice that a caller has."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from potr_cl.codec import quantize
from potr_cl.codec.container import EntropyCoder
from potr_cl.stages.compaction.ridge import ColourModel, CompactionOptions, Weighting
from potr_cl.stages.pruning.removal import SweepOptions
from potr_cl.stages.pruning.schedule import PruningOptions


@dataclass(frozen=True)
class EncodeOptions:
    """How to encode.

    Attributes:
        q: quality, 0 to 1; sets every hyper-parameter that is not given on its own.
        preset: how q sets them, and the file's version: :meth:`potr_cl.codec.quantize.HyperParameters.from_quality`.
            What else belongs to a preset comes with :meth:`for_preset`.
        lam, alpha, delta_mse_max, drop, beta, gamma, sf_dc, sf_sh, sf_opacity, sf_rotation, sf_scale: replace single
            hyper-parameters (:class:`potr_cl.codec.quantize.HyperParameters`).
        prune: remove splats; looks at views.
        iterations, mapping_a, decay: of the pruning schedule
            (:class:`potr_cl.stages.pruning.schedule.PruningOptions`).
        compact: make the SH coefficients sparse; looks at views.
        compact_at: the part of the pruning iterations after which that is done: later ones see its effect.
        colour_model, weighting, two_pass: of the compaction
            (:class:`potr_cl.stages.compaction.ridge.CompactionOptions`).
        refit: conjugate-gradient steps of the joint re-fit of the colours; 0 leaves it out. Looks at views.
        refit_at, refit_at_steps: the parts of the pruning iterations after which colours are re-fitted too, so that
            later ones judge by colours that have made up for what went, and the steps of each.
        photographs: folder of the views' photographs, named after them: what the last re-fit comes near to, instead of
            the uncompressed scene's pictures.
        count: number of splats to keep, instead of ΔMSE_MAX.
        sweep: what measuring removal effects may skip.
        background: R, G, B behind the scene in the views that pruning looks at.
        entropy: the entropy stage.
        threads: for the entropy stage; the bytes do not depend on it. 0: one a processor.
        source_bytes: size of the file that the scene came from, for the metadata; None if it came from none.
    """

    q: float = 0.5
    preset: quantize.Preset = "paper"
    lam: float | None = None
    alpha: float | None = None
    delta_mse_max: float | None = None
    drop: float | None = None
    beta: float | None = None
    gamma: float | None = None
    sf_dc: float | None = None
    sf_sh: float | None = None
    sf_opacity: float | None = None
    sf_rotation: float | None = None
    sf_scale: float | None = None
    prune: bool = True
    iterations: int = 48
    mapping_a: float = PruningOptions.a
    decay: float = PruningOptions.decay
    compact: bool = True
    compact_at: float = 0.75
    colour_model: ColourModel = CompactionOptions.colour_model
    weighting: Weighting = CompactionOptions.weighting
    two_pass: bool = CompactionOptions.two_pass
    refit: int = 0
    refit_at: tuple[float, ...] = ()
    refit_at_steps: int = 3
    ground_truth: Path | None = None
    count: int | None = None
    sweep: SweepOptions = field(default_factory=SweepOptions)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entropy: EntropyCoder = field(default_factory=EntropyCoder)
    threads: int = 0
    source_bytes: int | None = None

    @staticmethod
    def for_preset(preset: quantize.Preset, **changes: Any) -> EncodeOptions:
        """All that a preset means, with changes: keywords are attributes.

        Without a re-fit the colours are compacted, unless the changes say otherwise.
        """
        given: dict[str, Any] = {"preset": preset}
        if preset != "paper":
            given["refit"] = 8 if preset == "best" else 4
        if preset == "fast":
            given |= {"iterations": 16, "entropy": EntropyCoder("zstd", 9)}
        given |= changes
        return EncodeOptions(**{"compact": not given.get("refit"), **given})

    @property
    def parameters(self) -> quantize.HyperParameters:
        """The hyper-parameters that result."""
        names = ("lam", "alpha", "delta_mse_max", "drop", "beta", "gamma")
        factors = ("sf_dc", "sf_sh", "sf_opacity", "sf_rotation", "sf_scale")
        return quantize.HyperParameters.from_quality(
            self.q, self.preset, **{name: getattr(self, name) for name in (*names, *factors)}
        )

    @property
    def compaction(self) -> CompactionOptions:
        """How to compact with them."""
        parameters = self.parameters
        return CompactionOptions(
            lam=parameters.lam,
            alpha=parameters.alpha,
            sf_sh=parameters.sf_sh,
            two_pass=self.two_pass,
            colour_model=self.colour_model,
            weighting=self.weighting,
        )
