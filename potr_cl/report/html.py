"""One self-contained web page about an encode: sizes, quality view by view, pictures to compare, the course of pruning.

Made of the document of :func:`potr_cl.report.summary.encode_report`. The page loads nothing, and is the same for the
same encode apart from the times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from potr_cl.model.scene import FloatArray
from potr_cl.quality.compare import difference_map
from potr_cl.report.labels import BEFORE_AND_AFTER, difference_label, view_label
from potr_cl.report.parts import chart, data_uri, section, table, text
from potr_cl.report.style import ACCENT, PAGE, SERIES, STAGE
from potr_cl.report.summary import decibels

#: What the pictures show.
_PICTURES = (
    "<p>Drag the line in a picture: uncompressed is to its left, compressed to its right. Beside it is where they "
    "differ: black not at all, then red, yellow and white. Most differences are too small to be seen, so they are "
    "multiplied by the number below the picture.</p>\n"
)


@dataclass(frozen=True)
class PicturePair:
    """One view of both scenes.

    Attributes:
        title: why it is shown.
        view: its name.
        psnr: decibels; None for identical pictures.
        before, after: (H, W, 3) float32, uncompressed and compressed.
        photograph: (H, W, 3) float32, what was really there, if there is a photograph.
    """

    title: str
    view: str
    psnr: float | None
    before: FloatArray
    after: FloatArray
    photograph: FloatArray | None = None


def views_to_show(quality: dict[str, Any], chosen: str | None) -> list[tuple[str, dict[str, Any]]]:
    """A chosen view, the median and the worst of a report's quality, with titles; also the first if none is chosen."""
    views = quality["views"]
    by_psnr = sorted(views, key=lambda view: math.inf if view["psnr"] is None else view["psnr"])
    named = [view for view in views if view["name"] == chosen]
    wanted = {"chosen view": named[0]} if named else {}
    wanted |= {"typical view": by_psnr[(len(views) - 1) // 2], "worst view": by_psnr[0]}
    if not named:
        wanted["first view"] = views[0]
    shown: dict[str, tuple[str, dict[str, Any]]] = {}
    for title, view in wanted.items():
        if view["name"] in shown:
            title = f"{shown[view['name']][0]}, {title}"
        shown[view["name"]] = (title, view)
    return list(shown.values())


def html_report(report: dict[str, Any], pictures: Sequence[PicturePair]) -> str:
    """The page.

    Args:
        report: of :func:`potr_cl.report.summary.encode_report`.
        pictures: to compare; none where the encode was not judged.
    """
    source = report["source"]
    sections = [
        _headline(report),
        section("Pictures", _PICTURES + "".join(map(_pair, pictures))) if pictures else "",
        section("Where the bytes are", _sizes(report)),
        section("Quality by view", _quality(report["quality"])),
        section("Photographs", _photographs(report["photographs"])) if report.get("photographs") else "",
        section("Pruning", _pruning(report)) if report["pruning"] is not None else "",
        section("Search", _search(report["search"])) if report.get("search") is not None else "",
        section("Settings", _settings(report)),
        section("Command, time, device, versions", _circumstances(report)),
    ]
    title = f"{text(source['file'])} → {text(report['file'])}"
    return PAGE.substitute(title=title, accent=ACCENT, stage=STAGE, body="\n".join(filter(None, sections)))


def _headline(report: dict[str, Any]) -> str:
    source, quality = report["source"], report["quality"]
    ratio = report["ratio"]
    facts = [
        (f"{_megabytes(source['bytes'])} → {_megabytes(report['bytes'])}", "size"),
        (f"{ratio:.1f} ×" if ratio >= 1 else f"1 / {1 / ratio:.1f}", "smaller"),
        (f"{report['splats']:,}", f"of {source['splats']:,} splats"),
    ]
    if not isinstance(quality, str):
        facts += [
            (decibels(quality["psnr"]), "mean PSNR against the uncompressed scene"),
            (f"{quality['ssim']:.4f}", "mean SSIM"),
        ]
    cards = "".join(f"<div><b>{text(value)}</b><span>{text(name)}</span></div>" for value, name in facts)
    names = f"{text(source['file'])} → {text(report['file'])}"
    return f'<header><h1>{names}</h1><div class="cards">{cards}</div></header>'


def _megabytes(nbytes: int) -> str:
    return f"{nbytes / 1e6:.2f} MB" if nbytes >= 1e6 else f"{nbytes / 1e3:.2f} kB"


def _sizes(report: dict[str, Any]) -> str:
    total, splats = report["bytes"], report["splats"]
    bar, rows = [], []
    left = 0.0
    for colour, (name, nbytes) in zip(SERIES, report["properties"].items(), strict=False):
        width = 100 * nbytes / total
        tip = f"<title>{text(name)}: {nbytes:,} bytes</title>"
        bar.append(f'<rect x="{left:.3f}" width="{width:.3f}" height="6" fill="{colour}">{tip}</rect>')
        swatch = f'<i style="background:{colour}"></i>{text(name)}'
        rows.append([swatch, f"{nbytes:,}", f"{nbytes / splats:.2f}", f"{width:.1f} %"])
        left += width
    rows.append(["all", f"{total:,}", f"{total / splats:.2f}", "100 %"])
    svg = f'<svg class="bar" viewBox="0 0 100 6" preserveAspectRatio="none" role="img">{"".join(bar)}</svg>'
    return svg + table(["property", "bytes", "bytes per splat", "share"], rows)


def _pair(pair: PicturePair) -> str:
    heat, factor = difference_map(pair.before, pair.after)
    height, width = pair.before.shape[:2]
    name = text(pair.view)
    before, after = (text(label) for label in BEFORE_AND_AFTER)
    size = f'width="{width}" height="{height}"'
    return (
        f"<h3>{text(pair.title)}: {text(view_label(pair.view, pair.psnr))}</h3>\n"
        '<div class="pair"><figure><div class="slider">\n'
        f'<img {size} src="{data_uri(pair.before)}" alt="{name}, {before}">\n'
        f'<img {size} class="after" src="{data_uri(pair.after)}" alt="{name}, {after}">\n'
        '<input type="range" min="0" max="100" value="50" step="any" aria-label="'
        f'{before} to the left, {after} to the right" '
        "oninput=\"this.parentNode.style.setProperty('--at', this.value + '%')\"></div>\n"
        f"<figcaption>{before} | {after}</figcaption></figure>\n"
        f'<figure><img {size} src="{data_uri(heat)}" alt="{name}, difference">\n'
        f"<figcaption>{text(difference_label(factor))}: white is {round(255 / factor)} of 255 or more</figcaption>"
        f"</figure>{_photograph(pair, name, size)}</div>"
    )


def _photograph(pair: PicturePair, name: str, size: str) -> str:
    if pair.photograph is None:
        return ""
    shown = f'<img {size} src="{data_uri(pair.photograph)}" alt="{name}, photograph">'
    return f"\n<figure>{shown}\n<figcaption>photograph</figcaption></figure>"


def _quality(quality: dict[str, Any] | str) -> str:
    if isinstance(quality, str):
        return f"<p>{text(quality)}</p>"
    views = quality["views"]
    most = max((view["psnr"] for view in views if view["psnr"] is not None), default=1.0)
    rows = []
    for view in views:
        length = 100.0 if view["psnr"] is None else 100 * max(view["psnr"], 0) / max(most, 1e-9)
        worst = " (worst)" if view["name"] == quality["worst"]["name"] else ""
        bar = f'<span class="meter" style="width:{length:.1f}%"></span>'
        rows.append([text(view["name"]) + worst, decibels(view["psnr"]), bar, f"{view['ssim']:.4f}"])
    rows.append(["<b>mean</b>", f"<b>{decibels(quality['psnr'])}</b>", "", f"<b>{quality['ssim']:.4f}</b>"])
    said = f"<p>Against {text(quality['against'])}, judged by {text(quality['judged_by'])}.</p>"
    training = quality.get("training")
    if training is not None and training["said"] is not None:
        said += f"<p>{text(training['said'][0].upper() + training['said'][1:])}.</p>"
    return said + table(["view", "PSNR", "", "SSIM"], rows)


def _photographs(photographs: dict[str, Any]) -> str:
    which = "test views, which no stage has looked at" if photographs["kind"] == "test" else "training views"
    said = f"<p>PSNR against photographs of {which}.</p>"
    if photographs["held_out"] is not None:
        said += f"<p>While encoding: {text(photographs['held_out']['said'])}.</p>"
    if photographs["missing"] is not None:
        said += f"<p>{text(photographs['missing'])}.</p>"

    def row(name: str, figures: dict[str, float]) -> list[str]:
        before, after = figures["uncompressed"], figures["file"]
        return [name, f"{before:.2f} dB", f"{after:.2f} dB", f"{before - after:+.2f} dB"]

    rows = [row(text(view["name"]), view) for view in photographs["views"]]
    return said + table(["view", "uncompressed", "from the file", "lost"], [*rows, row("<b>mean</b>", photographs)])


def _pruning(report: dict[str, Any]) -> str:
    history = report["pruning"]["history"]
    if not history:
        return "<p>No splat was removed.</p>"
    left = [report["source"]["splats"], *(entry["left"] for entry in history)]
    growth = np.cumsum([entry["effect"] for entry in history]).tolist()
    largest = [entry["largest_effect"] for entry in history]
    return (
        f"<p>{left[0] - left[-1]:,} of {left[0]:,} splats removed in {len(history)} iterations.</p>\n"
        '<div class="charts">'
        + chart("splats left", [("", list(enumerate(left)))])
        + chart(
            "mean squared error",
            [
                ("estimated growth so far", list(enumerate(growth, 1))),
                ("largest ΔMSE of a removed splat", list(enumerate(largest, 1))),
            ],
            logarithmic=True,
        )
        + "</div>"
    )


def _search(search: dict[str, Any]) -> str:
    kinds = {
        "scout": "rough encode",
        "encode": "full encode",
        "refit": "its splats, re-fitted",
        "steps": "other quantiser steps",
        "colours": "other precision of colours",
    }
    rows = [[kinds[step["kind"]], f"{step['q']:g}", text(step["said"])] for step in search["tries"]]
    said = f"<p>Asked for: {text(search['target'])}. Reached: {text(search['reached'])}.</p>"
    return said + table(["step", "q", "result"], rows)


def _settings(report: dict[str, Any]) -> str:
    rows = [[text(name), f"{value:.6g}"] for name, value in report["parameters"].items()]
    others = {
        name: value
        if not isinstance(value, dict)
        else "off"
        if value.get("on") is False or value.get("steps") == 0
        else {field: each for field, each in value.items() if field not in report["parameters"]}
        for name, value in report["options"].items()
    }
    return (
        '<div class="columns">'
        + table(["parameter", "value"], rows)
        + table(["option", "value"], [[text(name), _value(value)] for name, value in others.items()])
        + "</div>"
    )


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "<br>".join(f"{text(str(name))}: {_value(entry)}" for name, entry in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_value(entry) for entry in value)
    return "–" if value is None else text(f"{value:.6g}" if isinstance(value, float) else str(value))


def _circumstances(report: dict[str, Any]) -> str:
    command = f"<p><code>{text(report['command'])}</code></p>" if report.get("command") else ""
    times = [[text(stage), f"{seconds:.1f} s"] for stage, seconds in report["seconds"].items()]
    facts = dict(report["versions"])
    if report["device"] is not None:
        device = report["device"]
        facts = {"device": device["name"], "platform": f"{device['platform']}, {device['version']}"} | facts
    rows = [[text(name), text(value)] for name, value in facts.items()]
    return command + f'<div class="columns">{table(["stage", "time"], times)}{table(["", ""], rows)}</div>'
