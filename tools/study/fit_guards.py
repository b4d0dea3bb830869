"""Is a file with the fit ever worse than one without? With few views, virtual ones, and thresholds set by hand.

    python -m tools.study.fit_guards SCENE … [--cases CASE …] [--as KIND …] [--qualities Q …] [--limit SECONDS]
        [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json with test views, or "excerpt": the tests' part of plush. A
case is what the encoder has: "8" of the training views, evenly spread; "virtual": cameras that it places itself;
"all"; or "all@3e-9": all of them, and that ΔMSE_MAX instead of q's. --fits are the steps that are asked for; what
follows a "+" are options of the fit, as "auto+between=3". --as changes the scene before all else: "degree 1" or "degree
0" cuts its SH, "antialiased" takes it for an antialiased one, "coloured background" puts one behind it, "huge splats"
makes every hundredth ten times larger and a third as opaque, "off-centre cameras" look past their pictures' centres.

For each case, a quality (or threshold) and those around it are encoded without a fit; bytes at equal PSNR are read
from that curve, on test views, which neither has seen. A fit that was left out must leave the file as it was, byte by
byte: then there is nothing to compare, and the table says why.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.stages.fitting.fit import Fitted
from tools.results import ROOT, Column, Results, Table
from tools.study.rate_distortion import size_at
from tools.workloads import read, scene_parser

COLUMNS = (
    Column("scene"),
    Column("as"),
    Column("views"),
    Column("q", format="g"),
    Column("ΔMSE_MAX by hand", format="g"),
    Column("fit"),
    Column("held-out views: without, with", "dB", "{:.2f} / {:.2f}"),
    Column("bytes without", format=",d"),
    Column("bytes with", format=",d"),
    Column("test views without", "dB", ".2f"),
    Column("test views with", "dB", ".2f"),
    Column("bytes at equal PSNR", "%", "+.1f"),
)
#: Qualities of the curve around one, and factors of thresholds around one.
_AROUND = (-0.2, -0.1, 0.0, 0.1, 0.2)
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


_BLACK, _COLOURED = (0.0, 0.0, 0.0), (0.3, 0.7, 0.5)
_AS_IT_IS = "it is"


def _huge(scene: Scene) -> Scene:
    log_scales, logits = scene.log_scales.copy(), scene.opacity_logits.copy()
    log_scales[::100] += np.log(10)
    logits[::100] -= np.log(3)
    return dataclasses.replace(scene, log_scales=log_scales, opacity_logits=logits)


def _off_centre(camera: Camera) -> Camera:
    return dataclasses.replace(camera, cx=camera.cx + 0.2 * camera.width, cy=camera.cy - 0.1 * camera.height)


#: Other scenes made of one, by what they are called.
KINDS: dict[str, Callable[[Scene], Scene]] = {
    _AS_IT_IS: lambda scene: scene,
    "degree 0": lambda scene: dataclasses.replace(scene, sh=scene.sh[:, :1].copy()),
    "degree 1": lambda scene: dataclasses.replace(scene, sh=scene.sh[:, :4].copy()),
    "antialiased": lambda scene: dataclasses.replace(scene, antialiased=True),
    "coloured background": lambda scene: scene,
    "huge splats": _huge,
    "off-centre cameras": lambda scene: scene,
}


@dataclass(frozen=True)
class Case:
    """What an encoder has.

    Attributes:
        views: "all", "virtual", or how many.
        threshold: ΔMSE_MAX by hand, if any.
    """

    views: str
    threshold: float | None

    @staticmethod
    def of(text: str) -> Case:
        """Read from a command line."""
        views, _, threshold = text.partition("@")
        return Case(views, float(threshold) if threshold else None)

    def cameras(self, scene: Scene, cameras: Sequence[Camera]) -> list[Camera]:
        """The views that it looks at."""
        if self.views == "virtual":
            return place_cameras(scene)
        views = train_views(cameras)
        count = len(views) if self.views == "all" else int(self.views)
        return [views[round(place)] for place in np.linspace(0, len(views) - 1, count)]


class Bench:
    """One scene on one device.

    Args:
        scene: the uncompressed one.
        cameras: all, with test views among them.
        device: to compute on.
        preset: of the encodes.
        kind: of :data:`KINDS`, which the scene is made.
    """

    def __init__(
        self,
        name: str,
        scene: Scene,
        cameras: Sequence[Camera],
        device: Device,
        preset: Any,
        kind: str = _AS_IT_IS,
    ) -> None:
        self.name, self._kind, self._device = name, kind, device
        self._scene = KINDS[kind](scene)
        self._cameras = [_off_centre(each) for each in cameras] if kind == "off-centre cameras" else list(cameras)
        background = _COLOURED if kind == "coloured background" else _BLACK
        self._options = EncodeOptions.for_preset(preset, background=background)
        self._judge = Evaluator(device, self._scene, EvaluationViews.of(test_views(self._cameras)), background)

    def _encode(self, views: Sequence[Camera], q: float, threshold: float | None, **fit: Any) -> tuple[Encoded, float]:
        options = self._options.changed(q=q, fit=fit)
        if threshold is not None:
            options = options.changed(prune={"delta_mse_max": threshold})
        encoded = encode(self._scene, views, options, device=self._device)
        return encoded, self._judge.psnr(encoded.scene)

    def measure(self, case: Case, q: float, fits: Sequence[dict[str, Any]], table: Table) -> None:
        """Put a row for each fit into the table."""
        views = case.cameras(self._scene, self._cameras)
        around = [(q + step, None) for step in _AROUND if 0 <= q + step <= 1]
        if case.threshold is not None:
            around = [(q, case.threshold * factor) for factor in _FACTORS]  # type: ignore[misc]
        curve = []
        for each, threshold in around:
            encoded, psnr = self._encode(views, each, threshold, steps=0)
            curve.append({"bytes": encoded.nbytes, "psnr": psnr})
            if (each, threshold) == (q, case.threshold):
                plain, bare = curve[-1], b"".join(encoded.pieces)
        for fit in fits:
            encoded, psnr = self._encode(views, q, case.threshold, **fit)
            fitted = encoded.fitted
            text = "+".join(f"{name}={value}" if name != "steps" else f"{value}" for name, value in fit.items())
            held_out: list[float] | None = None
            if isinstance(fitted, Fitted):
                before = fitted.errors[0] if fitted.without is None else fitted.without
                held_out = [-10 * float(np.log10(error)) for error in (before, fitted.error)]
                text += f": taken, {fitted.spared:,} splats fewer"
            else:
                same = b"".join(encoded.pieces) == bare
                text += f": left out ({getattr(fitted, 'why', 'off')}); " + ("same bytes" if same else "OTHER BYTES")
            same_psnr = size_at(curve, "psnr", psnr) if held_out else None
            table.add(
                self.name, self._kind, case.views, q, case.threshold, text, held_out, plain["bytes"], encoded.nbytes,
                plain["psnr"], psnr, 100 * (encoded.nbytes / same_psnr - 1) if same_psnr else None,
            )  # fmt: skip

    def close(self) -> None:
        """Give the device's memory back."""
        self._judge.close()


def _fit(text: str) -> dict[str, Any]:
    steps, *others = text.split("+")
    options: dict[str, Any] = {"steps": steps if steps == "auto" else int(steps)}
    for other in others:
        name, _, value = other.partition("=")
        options[name] = float(value) if "." in value else int(value)
    return options


def read_any(folder: Path) -> tuple[Scene, list[Camera]]:
    """A scene's folder, or "excerpt"."""
    if str(folder) != "excerpt":
        return read(folder)
    data = ROOT / "tests" / "data"
    return load_scene(data / "plush_excerpt.ply"), load_cameras(data / "plush_excerpt_cameras.json")


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--cases", nargs="+", type=Case.of, default=[Case.of(each) for each in ("8", "1", "virtual")])
    parser.add_argument("--as", nargs="+", choices=KINDS, default=[_AS_IT_IS], dest="kinds", metavar="KIND")
    parser.add_argument("--qualities", nargs="+", type=float, default=[0.3, 0.5], metavar="Q")
    parser.add_argument("--fits", nargs="+", type=_fit, default=[_fit("auto")], metavar="STEPS")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--limit", type=float, default=np.inf, metavar="SECONDS")
    args = parser.parse_args()
    began, device = time.perf_counter(), Device(args.device)
    table = Results(device.info, args.json).table(
        "guards", "Files with a fit against files without, test views", *COLUMNS
    )
    for folder, kind in itertools.product(args.scenes, args.kinds):
        bench = Bench(folder.resolve().name, *read_any(folder), device, args.preset, kind)
        for case in args.cases:
            for q in args.qualities:
                if time.perf_counter() - began > args.limit:
                    return
                bench.measure(case, q, args.fits, table)
        bench.close()


if __name__ == "__main__":
    main()
