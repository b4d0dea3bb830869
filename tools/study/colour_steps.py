"""What version 3 of the format brings over version 2, part by part, at several qualities.

    python -m tools.study.colour_steps measure SCENE … --json OUT.json [--qualities 0.3 0.5 0.7] [--every 3]
    python -m tools.study.colour_steps report OUT.json

A scene is pruned once for each quality; what is left is re-fitted and coded in each way: with the steps and coder of
version 2; with the coder of version 3; with steps of colours that fit each splat; with AC coefficients rounded before
the last solution for DC; with preset best's constants, which are coarser for AC coefficients and opacities; and with
colours rounded in rounds, as preset best does.
``report`` prints Markdown, with the bytes at equal PSNR: those of the first way are interpolated between qualities.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.quantize import HyperParameters, to_ycocg
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.code import Code
from potr_cl.stages.refit import Refit
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.refitting.targets import RenderedTargets
from potr_cl.stages.stage import State
from tools.results import circumstances, write_json
from tools.workloads import read, study_parser

#: Of version 2 at quality 0.5, steps a unit: of AC coefficients and of opacities' logits.
_FORMER = {"sf_sh": 48.0, "sf_opacity": 5.5}


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to re-fit and code.

    Attributes:
        name: in the table.
        version: of the file format.
        steps: whether each splat has its own steps of colours.
        rounded: whether AC coefficients are rounded before the last solution for DC.
        rounds: whether colours are rounded in rounds, between which the others are solved for again.
        former: whether with the constants of before.
    """

    name: str
    steps: bool = False
    rounded: bool = False
    rounds: bool = False
    former: bool = True


WAYS = (
    Way("steps that are the same for all splats"),
    Way("+ steps that fit each splat", steps=True),
    Way("+ AC coefficients rounded before the last solution for DC", steps=True, rounded=True),
    Way("+ coarser AC coefficients and opacities", steps=True, rounded=True, former=False),
    Way("+ colours rounded in rounds (preset best)", steps=True, rounds=True, former=False),
)


def coded(
    state: State, way: Way, parameters: HyperParameters, q: float, device: Device, options: RefitOptions
) -> bytes:
    """The file that a way makes of a pruned scene."""
    constants = {name: value * 10 ** (q - 0.5) for name, value in _FORMER.items()} if way.former else {}
    parameters = dataclasses.replace(parameters, **constants)  # type: ignore[arg-type]
    geometry = quantise_geometry(state.scene, parameters, state.views)

    def colour_grid(effects: FloatArray) -> ColourGrid:
        nonlocal geometry
        if way.steps:
            geometry = geometry.with_steps(effects)
        return ColourGrid.of(geometry)

    def fix_ac(sh: FloatArray, refit: ColourRefit) -> FloatArray:
        grid = colour_grid(refit.worth_of_constants())
        return rounded_ac(sh, grid.others) if way.rounded else sh

    decoded = geometry.decoded(state.scene.sh)
    with Rasterizer(device, state.source) as rasterizer:
        targets = RenderedTargets(rasterizer, state.views)
        fitted = refit_colours(
            device, decoded, state.views, targets, options,
            fix_ac=None if way.rounds else fix_ac, colour_grid=colour_grid if way.rounds else None,
        )  # fmt: skip
    scene = dataclasses.replace(state.scene, sh=fitted.sh)
    return b"".join(code_scene(scene, parameters, state.views, geometry=geometry).pieces)


def rounded_ac(sh: FloatArray, steps: NDArray[np.float32]) -> FloatArray:
    """Colours (N, M, 3) with AC coefficients of Y, Co, Cg rounded to the nearest multiples of (N,) steps."""
    y, co, cg = to_ycocg(sh[:, 1:].reshape(-1, 3).astype(np.float64))
    step = np.repeat(steps.astype(np.float64), sh.shape[1] - 1)
    y, co, cg = (np.floor(channel / step + 0.5) * step for channel in (y, co, cg))
    rounded = sh.copy()
    rounded[:, 1:] = np.stack([y + co - cg, y + cg, y - co - cg], axis=-1).reshape(sh[:, 1:].shape)
    return rounded


def measure(
    state: State, q: float, options: EncodeOptions, device: Device, views: Sequence[Camera]
) -> list[dict[str, Any]]:
    """Bytes and PSNR of every way at one quality."""
    figures = []
    chosen = EvaluationViews(list(views), "test", len(views))
    with Evaluator(device, state.source, chosen, (0.0, 0.0, 0.0)) as evaluator:
        for way in WAYS:
            data = coded(state, way, options.parameters, q, device, refit_options(options))
            figures.append({"way": way.name, "q": q, "bytes": len(data), "psnr": evaluator.psnr(decode(data))})
    return figures


def pruned_state(scene: Scene, views: Sequence[Camera], options: EncodeOptions, device: Device) -> State:
    """What the stages before the re-fit leave."""
    first = [type(stage) for stage in options.stages if not isinstance(stage, Refit | Code)]
    return Run(options, Stopwatch(), device).stages(State.of(scene, views), first)


def refit_options(options: EncodeOptions) -> RefitOptions:
    """How an encode with these options re-fits."""
    return RefitOptions(steps=options.stage(Refit).steps, drop=options.parameters.drop)


def _measure(args: argparse.Namespace) -> None:
    device = Device(args.device)
    results: dict[str, Any] = {**circumstances(device.info), "device": device.info.name, "scenes": {}}
    for folder in args.scenes:
        scene, cameras = read(folder)
        results["scenes"][folder.resolve().name] = figures = []
        for q in args.qualities:
            options = EncodeOptions.for_preset("best", q=q)
            state = pruned_state(scene, train_views(cameras), options, device)
            figures += measure(state, q, options, device, test_views(cameras)[:: args.every])
            write_json(args.json, results)


def equal_psnr(figures: Sequence[dict[str, Any]], figure: dict[str, Any]) -> float:
    """By how many percent a figure's bytes differ from the first way's at its PSNR; between or beside its qualities."""
    base = [each for each in figures if each["way"] == WAYS[0].name]
    place, logarithm = [each["psnr"] for each in base], [np.log(each["bytes"]) for each in base]
    curve = np.polyfit(place, logarithm, min(2, len(base) - 1)) if len(base) > 1 else np.array([0.0, logarithm[0]])
    return float(100 * np.expm1(np.log(figure["bytes"]) - np.polyval(curve, figure["psnr"])))


def _report(args: argparse.Namespace) -> None:
    results = json.loads(args.results.read_text())
    for name, figures in results["scenes"].items():
        print(f"### {name}, on {results['device']}\n")
        print("| way | q | bytes | PSNR, dB | bytes at equal PSNR, % |\n|---|---|---|---|---|")
        for each in figures:
            change = equal_psnr(figures, each)
            print(f"| {each['way']} | {each['q']:g} | {each['bytes']:,} | {each['psnr']:.3f} | {change:+.1f} |")
        print()


def main() -> None:
    parser, measuring, _ = study_parser(__doc__, _measure, _report)
    measuring.add_argument("--qualities", nargs="+", type=float, default=[0.3, 0.5, 0.7])
    measuring.add_argument("--every", type=int, default=1, help="look at every Nth test view only")
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
