"""What each part of the codec contributes, one added after the other.

    python -m tools.study.ablation measure SCENE … --json OUT.json [--quality Q]
    python -m tools.study.ablation report OUT.json

The steps are those of the paper's table "Ablation study": serialisation and quantisation, entropy coding, pruning,
SH compaction, YCoCg; those before YCoCg quantise R, G and B. The last two are ours: the re-fit, balanced steps and the
context coder, and then views between the training views, which make the preset best. A second table has the bytes a
splat of each property, compared with the float32 values of a PLY (normals left out). ``report`` prints Markdown.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from potr_cl.codec import quantize
from potr_cl.codec.decoder import PotrFile
from potr_cl.codec.encoder import code_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from tools.results import circumstances, write_json
from tools.study.evaluation import EvaluatedScene
from tools.workloads import reduced_state, study_parser

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


def _coded(
    evaluator: EvaluatedScene, scene: Scene, options: EncodeOptions, rgb: bool, views: Sequence[Camera]
) -> dict[str, Any]:
    """Code a scene as R, G, B or as Y, Co, Cg; what the file takes by property, and what it keeps."""
    coded = code_scene(as_channels(scene) if rgb else scene, options.parameters, views, entropy=options.code.coder)
    file = PotrFile.from_bytes(b"".join(coded.pieces))
    sections = file_report(file)["sections"]
    decoded = from_channels(file.scene()) if rgb else file.scene()
    figures: dict[str, Any] = {"splats": len(scene), "bytes": coded.nbytes, **evaluator(decoded)}
    columns = ["bytes"]
    # The context coder codes integers that were never bytes.
    if all(section["serialised_bytes"] is not None for section in sections.values()):
        figures["serialised_bytes"] = sum(section["serialised_bytes"] for section in sections.values())
        columns.append("serialised_bytes")
    for column in columns:
        figures[f"{column}_a_splat"] = {
            name: sum(sections[part][column] for part in parts if part in sections) / len(scene)
            for name, (parts, _) in PROPERTIES.items()
        }
    return figures


def measure_steps(evaluator: EvaluatedScene, device: Device, q: float) -> list[dict[str, Any]]:
    """All steps on one scene, the first without entropy coding."""
    options = EncodeOptions.for_preset("paper", q=q)
    plain = _coded(evaluator, evaluator.source, options, True, train_views(evaluator.cameras))
    serialised = {**plain, "bytes": plain["serialised_bytes"], "bytes_a_splat": plain["serialised_bytes_a_splat"]}
    steps = [{"step": "serialisation and quantisation", **serialised}, {"step": "entropy coding", **plain}]
    for name, changed, rgb in (
        ("pruning", options.changed(compact=False), True),
        ("SH compaction", options.changed(compact={"colour_model": "rgb"}), True),
        ("RGB → YCoCg", options, False),
        ("re-fit, balanced steps, contexts", EncodeOptions.for_preset("best", q=q, between=False), False),
        ("views between: preset best", EncodeOptions.for_preset("best", q=q), False),
    ):
        left = reduced_state(evaluator.source, train_views(evaluator.cameras), changed, device)
        steps.append({"step": name, **_coded(evaluator, left.scene, changed, rgb, left.views)})
    return steps


def _measure(args: argparse.Namespace) -> None:
    device = Device(args.device)
    about = circumstances(device.info)
    results: dict[str, Any] = {**about, "device": device.info.name, "q": args.quality, "scenes": {}}
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator:
            steps = measure_steps(evaluator, device, args.quality)
            results["scenes"][evaluator.name] = {**evaluator.facts(), "steps": steps}
            write_json(args.json, results)


def _report(args: argparse.Namespace) -> None:
    results = json.loads(args.results.read_text())
    for name, entry in results["scenes"].items():
        ground_truth = "truth_psnr" in entry["uncompressed"]
        print(f"### {name}, q = {results['q']:g}, on {results['device']}\n")
        head, rule = "| | splats | MB | PSNR, SSIM against uncompressed |", "|---|---|---|---|"
        row = f"| uncompressed | {entry['source_splats']:,} | {entry['source_bytes'] / 1e6:.1f} | |"
        if ground_truth:
            plain = entry["uncompressed"]
            head, rule = head + " PSNR, SSIM against photographs |", rule + "---|"
            row += f" {plain['truth_psnr']:.2f} dB, {plain['truth_ssim']:.4f} |"
        print(head, rule, row, sep="\n")
        for s in entry["steps"]:
            row = f"| + {s['step']} | {s['splats']:,} | {s['bytes'] / 1e6:.2f} | {s['psnr']:.2f} dB, {s['ssim']:.4f} |"
            if ground_truth:
                row += f" {s['truth_psnr']:.2f} dB, {s['truth_ssim']:.4f} |"
            print(row)
        steps = entry["steps"]
        print("\nBytes a splat:\n")
        print("| | as PLY | " + " | ".join(f"+ {s['step']}" for s in steps) + " | factor |")
        print("|---|---|" + "---|" * (len(steps) + 1))
        for prop, (_, values) in PROPERTIES.items():
            cells = [s["bytes_a_splat"][prop] for s in steps]
            factor = f"{4 * values / cells[-1]:.1f}" if cells[-1] else ""
            print(f"| {prop} | {4 * values} | " + " | ".join(f"{c:.2f}" for c in cells) + f" | {factor} |")
        totals = [sum(s["bytes_a_splat"].values()) for s in steps]
        raw = 4 * sum(values for _, values in PROPERTIES.values())
        print(f"| all | {raw} | " + " | ".join(f"{t:.2f}" for t in totals) + f" | {raw / totals[-1]:.1f} |\n")


def main() -> None:
    parser, measure, _ = study_parser(__doc__, _measure, _report)
    measure.add_argument("--quality", type=float, default=0.5)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
