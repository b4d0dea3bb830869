"""What an encode did, as one document for programs and as lines for people."""

from __future__ import annotations

import dataclasses
import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from potr_cl import __version__
from potr_cl.model.scene import Scene
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.target import Found, Target
from potr_cl.plain_text import plain_document
from potr_cl.quality.compare import Comparison, mean_view
from potr_cl.quality.evaluator import EvaluationViews
from potr_cl.quality.figures import Figures
from potr_cl.quality.photographs import PhotographFigures

#: By how many decibels held-out views may be matched worse than training views before the reader is told why.
_APART = 6.0
#: Views that show the quarter of a scene which the fewest show: with fewer, training views say little of others.
_FEW = 8
#: Packages whose version may change the bytes.
_PACKAGES = ("numpy", "pyopencl", "zstandard")


class EncodeReport(dict[str, Any]):
    """The facts of an encode; printed, they are lines for people."""

    def __str__(self) -> str:
        return format_encode_report(self)


def encode_report(
    source: Path,
    scene: Scene,
    target: Path,
    encoded: Encoded,
    source_bytes: int | None,
    search: dict[str, Any] | None,
    quality: dict[str, Any] | str,
    seconds: dict[str, float],
    photographs: dict[str, Any] | None = None,
    command: str | None = None,
) -> EncodeReport:
    """The facts of an encode, ready for JSON.

    Args:
        source, target: paths of the uncompressed and the compressed file.
        scene: the uncompressed scene.
        encoded: the file, and how it came about.
        source_bytes: size of ``source``; None: it comes from no file, and the bytes of its arrays stand for it.
        search: of :func:`search_report`, where the options were found by a search.
        quality: of :func:`quality_report`, or why it was not judged.
        seconds: wall time by stage, in order; "total" last.
        photographs: of :func:`photographs_report`, where photographs were fitted to.
        command: the command line, where there was one.
    """
    source_bytes = scene.nbytes if source_bytes is None else source_bytes
    nbytes, splats, options = encoded.nbytes, len(encoded.order), encoded.options
    report: dict[str, Any] = {
        "source": {
            "file": str(source),
            "bytes": source_bytes,
            "splats": len(scene),
            "sh_degree": scene.sh_degree,
            "antialiased": scene.antialiased,
        },
        "file": str(target),
        "bytes": nbytes,
        "ratio": source_bytes / nbytes,
        "splats": splats,
        "bytes_a_splat": nbytes / splats,
        "levels": [dataclasses.asdict(level) for level in encoded.levels if len(encoded.levels) > 1],
        "properties": options.output.properties(encoded.data),
        "quality": quality,
        "photographs": photographs,
        "pruning": None,
        "unseen": None,
        "fit": None,
        "views_between": None,
        "search": search,
        "options": options.as_dict(),
        "parameters": dataclasses.asdict(encoded.parameters),
        "device": None,
        "shared": None,
        "seconds": seconds,
        "command": command,
        "versions": {"potr_cl": __version__, "python": platform.python_version()}
        | {package: version(package) for package in _PACKAGES},
    }
    if encoded.pruned is not None:
        report["pruning"] = {
            "iterations": encoded.pruned.iterations,
            "history": [dataclasses.asdict(entry) for entry in encoded.pruned.history],
        }
    if encoded.unseen is not None:
        report["unseen"] = {**encoded.unseen.facts, "said": str(encoded.unseen)}
    if encoded.fitted is not None:
        report["fit"] = {**encoded.fitted.facts, "said": str(encoded.fitted)}
    if encoded.between is not None:
        report["views_between"] = {**dataclasses.asdict(encoded.between), "said": str(encoded.between)}
    if encoded.shared is not None:
        report["shared"] = {**dataclasses.asdict(encoded.shared), "said": str(encoded.shared)}
    if encoded.device is not None:
        info = encoded.device.info
        report["device"] = {"name": info.name, "platform": info.platform, "version": info.version}
    return EncodeReport(plain_document(report))


def search_report(target: Target, found: Found) -> dict[str, Any]:
    """What was searched for, and how it was found."""
    return {
        "target": str(target),
        "max_bytes": target.max_bytes,
        "min_psnr": target.min_psnr,
        "reached": target.describe(found.value),
        "tries": [
            {"kind": step.kind, "q": step.q, "value": target.plain(step.value), "said": target.describe(step.value)}
            for step in found.tries
        ],
    }


def quality_report(views: EvaluationViews, comparison: Comparison, beside: float | None = None) -> dict[str, Any]:
    """The figures of the views that an encode was judged by.

    Args:
        views: these.
        comparison: what they show.
        beside: mean PSNR on the training views beside them; None: there are none.
    """

    def entry(name: str, figures: Figures) -> dict[str, Any]:
        """JSON knows no infinity: a PSNR of null means identical pictures."""
        return {"name": name, "psnr": figures.psnr if math.isfinite(figures.psnr) else None, "ssim": figures.ssim}

    judged = [entry(view.name, view.figures["b_against_a"]) for view in comparison.views]
    mean = entry("mean", mean_view(comparison.views).figures["b_against_a"])
    return {
        "against": "the uncompressed scene",
        "kind": views.kind,
        "judged_by": str(views),
        "psnr": mean["psnr"],
        "ssim": mean["ssim"],
        "worst": judged[comparison.worst],
        "training": None if beside is None else _training(mean["psnr"], beside, len(views.beside)),
        "views": judged,
    }


def _training(judged: float | None, training: float, views: int) -> dict[str, Any]:
    """How well training views are matched, and what that says of held-out ones."""
    said = None
    if judged is not None and training > judged + _APART:
        how = f"{training - judged:.1f} dB worse than training views" if math.isfinite(training) else "worse"
        said = (
            f"the held-out views are matched {how}: they show parts or directions that the training views do not; "
            "give more cameras, or --views-between 3"
        )
    return {"psnr": training if math.isfinite(training) else None, "views": views, "said": said}


def photographs_report(encoded: Encoded, missing: str | None, figures: PhotographFigures) -> dict[str, Any]:
    """What photographs say of an encode that was asked to fit to them.

    Args:
        encoded: the encode, which knows what held-out photographs said on the way.
        missing: which views have no photograph, in a line.
        figures: of the scene and the file.
    """
    uncompressed, file = figures.means
    choice, held_out = encoded.photographs, None
    if choice is not None:
        held_out = {**dataclasses.asdict(choice), "kept": choice.kept, "said": str(choice)}
    return {
        "held_out": held_out,
        "missing": missing,
        "kind": figures.kind,
        "uncompressed": uncompressed,
        "file": file,
        "views": [
            {"name": name, "uncompressed": before, "file": after}
            for name, before, after in zip(figures.views, figures.uncompressed, figures.file, strict=True)
        ],
    }


def decibels(value: float | None) -> str:
    """A PSNR of a report, for people."""
    return "identical" if value is None else f"{value:.2f} dB"


def format_encode_report(report: dict[str, Any]) -> str:
    """The report as lines for people."""
    source = report["source"]
    ratio = report["ratio"]
    change = f"{ratio:.1f} times smaller" if ratio >= 1 else f"{1 / ratio:.1f} times larger"
    lines = [
        f"{report['file']}: {report['bytes']:,} bytes, {change} than {source['file']} ({source['bytes']:,} bytes)",
        f"splats     {report['splats']:,} of {source['splats']:,}, {report['bytes_a_splat']:.2f} bytes each",
    ]
    if report["unseen"] is not None and report["unseen"]["splats"]:
        lines.append(f"           {report['unseen']['said']}")
    if report["views_between"] is not None:
        lines.append(f"views      {report['views_between']['said']}")
    if source["antialiased"]:
        lines.append("rendered   as an antialiased scene")
    for place, (name, nbytes) in enumerate(report["properties"].items()):
        lines.append(f"{'' if place else 'bytes':<11}{name:<18}{nbytes:>13,}{100 * nbytes / report['bytes']:>7.1f} %")
    quality = report["quality"]
    if isinstance(quality, str):
        lines.append(f"quality    {quality}")
    else:
        worst = quality["worst"]
        lines += [
            f"quality    PSNR {decibels(quality['psnr'])}, SSIM {quality['ssim']:.4f} against the uncompressed scene,",
            f"           mean of {quality['judged_by']}",
            f"           worst view {worst['name']}: PSNR {decibels(worst['psnr'])}, SSIM {worst['ssim']:.4f}",
        ]
        if quality.get("training") is not None and quality["training"]["said"] is not None:
            lines.append(f"           {quality['training']['said']}")
        elif quality["kind"] == "train" and report["views_between"] is not None:
            shown_by = report["views_between"]["shown_by"]
            if shown_by is not None and shown_by < _FEW:
                lines.append(
                    f"           a quarter of the scene is shown by no more than {shown_by:.0f} of them: "
                    "from other directions it may match far worse"
                )
    if report.get("levels"):
        lines += [
            f"{'' if number else 'levels':<11}{number}: {level['splats']:,} splats"
            + (f", PSNR {decibels(level['psnr'])}" if isinstance(quality, dict) else "")
            + (f" in views of {level['scale']:.2f} times the size" if number else "")
            for number, level in enumerate(report["levels"])
        ]
    if report.get("fit") is not None:
        lines.append(f"fit        {report['fit']['said']}")
    photographs = report["photographs"]
    if photographs is not None:
        held_out = photographs["held_out"]
        said = [] if held_out is None else [held_out["said"]]
        which = "test" if photographs["kind"] == "test" else "training"
        count = len(photographs["views"])
        said.append(
            f"PSNR {photographs['uncompressed']:.2f} dB uncompressed, {photographs['file']:.2f} dB from the file, "
            f"against {count} photograph{'s' if count > 1 else ''} of {which} views"
        )
        lines += [f"{'' if place else 'photos':<11}{line}" for place, line in enumerate(said)]
    search = report["search"]
    if search is not None:
        encodes = sum(step["kind"] == "encode" for step in search["tries"])
        full = f"{encodes} full encode{'s' if encodes > 1 else ''}"
        q = report["options"]["q"]
        lines.append(f"target     {search['target']}: {search['reached']} at quality {q:g} ({full})")
    times = dict(report["seconds"])
    total = times.pop("total")
    lines.append(f"time       {total:.1f} s: " + ", ".join(f"{stage} {time:.1f}" for stage, time in times.items()))
    if report["device"] is not None:
        lines.append(f"device     {report['device']['name']} ({report['device']['platform']})")
    if report["shared"] is not None:
        lines.append(f"workers    {report['shared']['said']}")
    return "\n".join(lines)
