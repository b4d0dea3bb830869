"""What each part of the codec contributes, one added after the other.

    python -m tools.study.ablation SCENE … [--quality Q] [--json FILE]

The steps are those of the paper's table "Ablation study": serialisation and quantisation, entropy coding, pruning,
SH compaction, YCoCg; those before YCoCg quantise R, G and B. The others are ours: the re-fit with steps of equal worth
and bundles; and views between the training views, which make the preset best. A second table has the bytes a
splat of each property, compared with the float32 values of a PLY (normals left out).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from potr_cl.codec import quantize
from potr_cl.codec.decoder import open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.model.camera import train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from potr_cl.stages.stage import State
from tools.results import Column, Results
from tools.study.evaluation import EvaluatedScene
from tools.workloads import reduced, scene_parser

#: The paper's properties, the sections of a file that hold each, and float32 values a splat in a PLY of degree 3.
PROPERTIES = {
    "position": (("position: octree", "position: tails"), 3),
    "scale": (("scale",), 3),
    "opacity": (("opacity",), 1),
    "rotation": (("rotation",), 4),
    "DC": (("colour: DC",), 3),
    "AC": (("colour: AC degree 1", "colour: AC degree 2", "colour: AC degree 3"), 45),
}


def as_channels(scene: Scene) -> Scene:
    """The scene whose Y, Co and Cg are this one's R, G and B: to code it is to code R, G and B as they are."""
    y, co, cg = np.moveaxis(scene.sh, -1, 0)
    return dataclasses.replace(scene, sh=np.stack([y + co - cg, y + cg, y - co - cg], axis=-1))


def from_channels(scene: Scene) -> Scene:
    """The inverse of :func:`as_channels`."""
    channels = quantize.to_ycocg(scene.sh.reshape(-1, 3).astype(np.float64))
    return dataclasses.replace(scene, sh=np.stack(channels, axis=-1).astype(np.float32).reshape(scene.sh.shape))


def _figures(evaluator: EvaluatedScene, data: bytes, rgb: bool = False) -> dict[str, Any]:
    """What a file takes by property, and what it keeps; ``rgb``: of a scene that was coded :func:`as_channels`."""
    file = open_file(data)
    splats, sections = file.header.splats, file_report(file)["sections"]
    decoded = from_channels(file.scene()) if rgb else file.scene()
    figures: dict[str, Any] = {"splats": splats, "bytes": len(data), **evaluator(decoded)}
    columns = ["bytes"]
    # Bundles code integers that were never bytes.
    if all(section["serialised_bytes"] is not None for section in sections.values()):
        figures["serialised_bytes"] = sum(section["serialised_bytes"] for section in sections.values())
        columns.append("serialised_bytes")
    for column in columns:
        figures[f"{column}_a_splat"] = {
            name: sum(sections[part][column] for part in parts if part in sections) / splats
            for name, (parts, _) in PROPERTIES.items()
        }
    return figures


def _plain(evaluator: EvaluatedScene, options: EncodeOptions, state: State, rgb: bool) -> dict[str, Any]:
    """Code a scene with steps that are the same for all splats, as R, G, B or as Y, Co, Cg."""
    scene = as_channels(state.scene) if rgb else state.scene
    coded = code_scene(scene, options.parameters, state.views, entropy=options.code.coder)
    return _figures(evaluator, b"".join(coded.pieces), rgb)


def measured_steps(evaluator: EvaluatedScene, device: Device, q: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """All steps on one scene, the first without entropy coding."""
    options, views = EncodeOptions.for_preset("paper", q=q), train_views(evaluator.cameras)
    plain = _plain(evaluator, options, State.of(evaluator.source, views), True)
    serialised = {"bytes": plain["serialised_bytes"], "bytes_a_splat": plain["serialised_bytes_a_splat"]}
    yield "serialisation and quantisation", {**plain, **serialised}
    yield "entropy coding", plain
    for name, changed, rgb in (
        ("pruning", options.changed(compact=False), True),
        ("SH compaction", options.changed(compact={"colour_model": "rgb"}), True),
        ("RGB → YCoCg", options, False),
    ):
        yield name, _plain(evaluator, changed, reduced(evaluator.source, views, changed, device), rgb)
    best = EncodeOptions.for_preset("best", q=q)
    for name, changed in (
        ("re-fit, steps of equal worth, contexts", best.changed(between=False)),
        ("views between the training views: preset best", best),
    ):
        yield name, _figures(evaluator, encode(evaluator.source, views, changed, device=device).data)


def study(results: Results, evaluator: EvaluatedScene, device: Device, q: float) -> None:
    """The two tables of a scene."""
    name, facts = evaluator.name, evaluator.facts()
    table = results.table(
        name, f"The steps of the paper's ablation, then those to preset best: {name}, q = {q:g}",
        "step; splats||,; size|MB|.3f; PSNR against uncompressed|dB|.2f; SSIM against uncompressed||.4f; "
        "PSNR against photographs|dB|.2f; SSIM against photographs||.4f",
    )  # fmt: skip
    truth = [facts["uncompressed"].get(figure) for figure in ("truth_psnr", "truth_ssim")]
    table.add("uncompressed", facts["source_splats"], facts["source_bytes"] / 1e6, None, None, *truth)
    steps = {}
    for step, s in measured_steps(evaluator, device, q):
        figures = (s.get(figure) for figure in ("psnr", "ssim", "truth_psnr", "truth_ssim"))
        table.add(f"+ {step}", s["splats"], s["bytes"] / 1e6, *figures)
        steps[f"+ {step}"] = [s["bytes_a_splat"][prop] for prop in PROPERTIES]
    heads = (Column(prop, format=".2f") for prop in (*PROPERTIES, "all"))
    parts = results.table(f"bytes_{name}", f"Bytes a splat after each step: {name}, q = {q:g}", "step", *heads)
    floats = [4.0 * values for _, values in PROPERTIES.values()]
    for step, own in {"as PLY": floats, **steps}.items():
        parts.add(step, *own, sum(own))


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--quality", type=float, default=0.5)
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator:
            study(results, evaluator, device, args.quality)


if __name__ == "__main__":
    main()
