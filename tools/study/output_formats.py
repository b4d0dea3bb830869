"""Encodes straight to the formats that viewers open: bytes and loss, judged through our readers and through others'.

    python -m tools.study.output_formats measure SCENE … --json OUT.json --keep DIR [--seconds S] [options]
    python -m tools.study.output_formats judge SCENE … --json OUT.json --keep DIR [--reader NAME] [--transform COMMAND]
    python -m tools.study.output_formats report OUT.json FORMATS.json [--json RESULTS.json]

``measure`` prunes each scene once for each quality, and from there makes every output of :data:`PLAN`; a file of each
is kept in DIR. It also writes the whole scene with convert's writers. It stops before a step that would begin after S
seconds. ``judge`` has splat-transform (npm's @playcanvas/splat-transform) or gaussforge (PyPI's, with Niantic's own
library for SPZ) decode the kept files to PLY and judges those, on any machine. ``report`` prints Markdown: how many
times smaller a file of the same PSNR, and of the same loss on photographs, is than the other writers' files of
FORMATS.json, which tools.study.compare_formats has made, by interpolation; --json keeps the tables for docs/benchmarks.
Results may be given in several files.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from potr_cl.formats import load_scene, save_scene
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.outputs.registry import output_of_suffix
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.stages.code import Code
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import State
from tools.results import Column, Results, circumstances, write_json
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import size_at

#: The outputs of each quality, the most interesting first: a suffix, and a version behind a colon.
PLAN: dict[float, tuple[str, ...]] = {
    0.5: (".spz:2", ".sog", ".compressed.ply", ".spz:4"),
    0.3: (".spz:2", ".sog", ".compressed.ply"),
    0.8: (".compressed.ply", ".spz:2", ".sog"),
    0.1: (".spz:2", ".sog"),
}
#: Written whole, as convert does.
CONVERTED = (".spz", ".compressed.ply", ".sog")
#: What splat-transform reads.
_READ_BY_OTHERS = (".spz", ".compressed.ply", ".sog")


# ------------------------------------------------------------------------------------------- measurement


def _measure(args: argparse.Namespace) -> None:
    began = time.perf_counter()
    device = Device(args.device)
    results: dict[str, Any] = {"scenes": {}, **circumstances(device.info), "device": device.info.name}

    def in_time() -> bool:
        return bool(time.perf_counter() - began < args.seconds)

    for q, names in _plan(args).items():
        for folder in args.scenes:
            if not in_time():
                break
            with EvaluatedScene(folder, device) as evaluator:
                entry = results["scenes"].setdefault(
                    evaluator.name, {**evaluator.facts(), "encodes": [], "converts": []}
                )
                options = EncodeOptions(q=q).changed(fit={"steps": args.fit})
                watch = Stopwatch()
                first = [type(stage) for stage in options.stages]
                state = Run(options, watch, device).stages(
                    State.of(evaluator.source, train_views(evaluator.cameras)), first[: first.index(Refit)]
                )
                for name in names:
                    if in_time():
                        entry["encodes"].append(_encoded(args, evaluator, state, q, name, dict(watch.seconds), device))
                        write_json(args.json, results)
    for folder in args.scenes if args.whole else []:
        with EvaluatedScene(folder, device) as evaluator:
            for suffix in CONVERTED:
                if in_time():
                    results["scenes"][evaluator.name]["converts"].append(_converted(args, evaluator, suffix))
                    write_json(args.json, results)


def _plan(args: argparse.Namespace) -> dict[float, tuple[str, ...]]:
    """The outputs to make of each quality."""
    plan = {q: args.formats or PLAN.get(q, PLAN[0.5]) for q in args.q or PLAN}
    return {q: tuple(names) for q, names in plan.items()}


def _encoded(
    args: argparse.Namespace,
    evaluator: EvaluatedScene,
    state: State,
    q: float,
    name: str,
    seconds: dict[str, float],
    device: Device,
) -> dict[str, Any]:
    """One output of a pruned scene, judged through our own reader."""
    suffix, _, version = name.partition(":")
    output = output_of_suffix(suffix, version=int(version) if version else None)
    watch = Stopwatch()
    run = Run(EncodeOptions(q=q, output=output), watch, device)
    encoded = run.finished(run.stages(state, [Refit, Code]))
    kept = None
    if suffix in _READ_BY_OTHERS:
        fit = f"fit{args.fit}" if args.fit else ""
        path = args.keep / evaluator.name / f"{q:g}{'v' + version if version else ''}{fit}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        encoded.save(path)
        kept = str(path.relative_to(args.keep))
    point = {
        "format": name,
        "q": q,
        "fit": args.fit,
        "bytes": encoded.nbytes,
        "splats": len(encoded.order),
        "properties": output.properties(encoded.data),
        "seconds": {**seconds, **watch.seconds},
        "file": kept,
        **evaluator(encoded.scene),
    }
    print(
        f"{evaluator.name} {name} q {q:g} fit {args.fit}: {point['splats']} splats, {point['bytes']} bytes, "
        f"{point['psnr']:.2f} dB, lost {point.get('psnr_loss') or 0:.2f} dB",
        flush=True,
    )
    return point


def _converted(args: argparse.Namespace, evaluator: EvaluatedScene, suffix: str) -> dict[str, Any]:
    """The whole scene in a format, as convert writes it."""
    path = args.keep / evaluator.name / f"whole{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    save_scene(path, evaluator.source)
    seconds = time.perf_counter() - began
    point = {"format": suffix, "bytes": path.stat().st_size, "seconds": seconds, **evaluator(load_scene(path))}
    path.unlink()  # nobody judges it again, and it is large
    print(f"{evaluator.name} {suffix} whole: {point['bytes']} bytes, {point['psnr']:.2f} dB", flush=True)
    return point


def _judge(args: argparse.Namespace) -> None:
    """Add to each kept file's point what it loses as another reader decodes it."""
    results = json.loads(args.json.read_text())
    device = Device(args.device)
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator, tempfile.TemporaryDirectory() as temporary:
            for point in results["scenes"][evaluator.name]["encodes"]:
                readers = point.setdefault("other_readers", {})
                if point["file"] is None or args.reader in readers:
                    continue
                decoded = Path(temporary) / "decoded.ply"
                complaint = READERS[args.reader](args.keep / point["file"], decoded, args.transform)
                if complaint:
                    print(f"{point['file']}: refused: {complaint[-300:]}", file=sys.stderr)
                    continue
                readers[args.reader] = evaluator(load_scene(decoded))
                write_json(args.json, results)
                other = readers[args.reader]["psnr"]
                print(f"{point['file']}: {point['psnr']:.3f} dB, {other:.3f} dB by {args.reader}", flush=True)


def _by_splat_transform(file: Path, ply: Path, command: str) -> str:
    """Decode a file to a PLY; what is wrong with it, or nothing."""
    made = subprocess.run([*shlex.split(command), "-w", str(file), str(ply)], capture_output=True, text=True)
    return made.stderr.strip() or "it failed" if made.returncode else ""


def _by_gaussforge(file: Path, ply: Path, _: str) -> str:
    """The same with a library of another author."""
    import gaussforge

    kind = file.name.removesuffix(".ply").rpartition(".")[2]
    made = gaussforge.GaussForge().convert(file.read_bytes(), "compressed.ply" if kind == "compressed" else kind, "ply")
    if made.get("error"):
        return str(made["error"])
    ply.write_bytes(bytes(made["data"]))
    return ""


#: Who may read the files besides the package.
READERS = {"splat-transform": _by_splat_transform, "gaussforge": _by_gaussforge}


# ------------------------------------------------------------------------------------------------ report


def _report(args: argparse.Namespace) -> None:
    *files, others = (json.loads(path.read_text()) for path in [*args.results, args.formats])
    results = files[0]
    for more in files[1:]:
        for name, entry in more["scenes"].items():
            for kind in ("encodes", "converts"):
                results["scenes"][name][kind] += entry[kind]
    tables = Results(None, args.json)
    for name, entry in results["scenes"].items():
        table = tables.table(
            f"outputs_{name}",
            f"Encodes straight to other formats: {name}, all test views",
            Column("format"),
            Column("q", format="g"),
            Column("fit", "steps"),
            Column("splats", format=","),
            Column("size", "MB", ".2f"),
            Column("PSNR", "dB", ".2f"),
            Column("lost", "dB", ".2f"),
            *(Column(f"PSNR by {reader}", "dB", ".2f") for reader in READERS),
            Column("time after pruning", "s", ".1f"),
        )
        for point in sorted(entry["encodes"], key=lambda p: (p["format"], p.get("fit", 0), p["q"])):
            after = sum(value for stage, value in point["seconds"].items() if stage in ("fit", "refit", "pack"))
            readers = point.get("other_readers", {})
            others_psnr = [readers.get(reader, {}).get("psnr") for reader in READERS]
            table.add(
                point["format"], point["q"], point.get("fit") or None, point["splats"], point["bytes"] / 1e6,
                point["psnr"], point.get("psnr_loss"), *others_psnr, after,
            )  # fmt: skip
        for point in entry["converts"]:
            table.add(
                f"{point['format']}, all splats", None, None, entry["source_splats"], point["bytes"] / 1e6,
                point["psnr"], point.get("psnr_loss"), *[None] * len(READERS), point["seconds"],
            )  # fmt: skip
        times = tables.table(
            f"outputs_gain_{name}",
            f"How many times smaller than other writers' files of the same PSNR, and of the same loss: {name}",
            Column("format"),
            Column("fit", "steps"),
            Column("other writer's size", "MB", ".2f"),
            Column("PSNR", "dB", ".2f"),
            Column("encode at that PSNR", "MB", ".2f"),
            Column("times smaller", format=".2f"),
            Column("lost", "dB", ".2f"),
            Column("encode at that loss", "MB", ".2f"),
            Column("times smaller at that loss", format=".2f"),
        )
        kinds = sorted({(point["format"], point.get("fit", 0)) for point in entry["encodes"]})
        for other in others["scenes"].get(name, {}).get("formats", []):
            for kind, fit in kinds:
                if kind.partition(":")[0].lstrip(".") != other["format"].lstrip("."):
                    continue
                points = [p for p in entry["encodes"] if (p["format"], p.get("fit", 0)) == (kind, fit)]
                if len(points) < 2:
                    continue
                cells: list[Any] = [kind, fit or None, other["bytes"] / 1e6]
                # A curve rises with PSNR and falls with what is lost.
                for key, sign in (("psnr", 1), ("psnr_loss", -1)):
                    curve = [{"bytes": p["bytes"], key: sign * p[key]} for p in points if p.get(key) is not None]
                    value = other.get(key)
                    cells += [value, *_gain(curve, key, None if value is None else sign * value, other["bytes"])]
                times.add(*cells)


def _gain(curve: list[dict[str, Any]], key: str, value: float | None, other: int) -> tuple[Any, Any]:
    """Where a curve reaches a value, in MB, and how many times smaller that is; bounds where all of it is better."""
    if value is None or not curve:
        return None, None
    least = min(curve, key=lambda p: int(p["bytes"]))
    if value <= least[key]:
        return f"below {least['bytes'] / 1e6:.2f}", f"more than {other / least['bytes']:.2f}"
    size = size_at(curve, key, value) if len(curve) > 1 else None
    return size and size / 1e6, size and other / size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, run in (("measure", _measure), ("judge", _judge)):
        sub = commands.add_parser(name)
        sub.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
        sub.add_argument("--json", type=Path, required=True)
        sub.add_argument("--keep", type=Path, required=True, help="folder of the files")
        sub.add_argument("--device", help="OpenCL device")
        sub.set_defaults(run=run)
        if name == "measure":
            sub.add_argument("--seconds", type=float, default=1e9, help="begin nothing after so long")
            sub.add_argument("--q", type=float, nargs="*", help="qualities; default: those of the plan")
            sub.add_argument("--formats", nargs="*", help="outputs of each; default: the plan's")
            sub.add_argument("--fit", type=int, default=0, metavar="STEPS", help="fit all parameters too")
            sub.add_argument("--no-whole", dest="whole", action="store_false", help="no files of the whole scene")
        else:
            sub.add_argument("--reader", choices=READERS, default="splat-transform")
            sub.add_argument("--transform", default="splat-transform", help="its command; default %(default)s")
    sub = commands.add_parser("report")
    sub.add_argument("results", type=Path, nargs="+", metavar="OUT.json")
    sub.add_argument("formats", type=Path, help="of tools.study.compare_formats")
    sub.add_argument("--json", type=Path)
    sub.set_defaults(run=_report)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
