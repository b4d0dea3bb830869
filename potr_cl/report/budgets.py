"""A web page about levels of detail: how near is what is shown, for how many splats? (:func:`budgets_page`)"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.report.parts import chart, data_uri, section, table, text
from potr_cl.report.style import ACCENT, PAGE, STAGE
from potr_cl.report.summary import decibels


def budgets_page(report: dict[str, Any], picture: NDArray[np.uint8], caption: str) -> str:
    """The page; it loads nothing.

    Args:
        report: of :meth:`potr_cl.api.budgets.BudgetComparison.report`.
        picture: (H, W, 3) of the worst view.
        caption: what it shows.
    """
    lines: dict[str, list[tuple[float, float]]] = {}
    for each in report["budgets"]:
        if each["psnr"] is not None:
            lines.setdefault(f"{each['file']}, by {each['levels_by']}", []).append((each["splats"], each["psnr"]))
    curve = chart("PSNR, dB, by splats shown", [(name, sorted(line)) for name, line in lines.items()], from_zero=False)
    files = [
        [text(each["file"]), f"{each['bytes']:,}", f"{each['leaves']:,}", ", ".join(f"{n:,}" for n in each["splats"])]
        for each in report["files"]
    ]
    shown = [
        [
            f"{each['budget']:,}", text(each["file"]), text(each["levels_by"]), f"{each['splats']:,.0f}",
            decibels(each["psnr"]), f"{each['ssim']:.4f}", decibels(each["worst_psnr"]),
        ]
        for each in report["budgets"]
    ]  # fmt: skip
    sections = [
        f"<header><h1>{text(report['a'])}</h1></header>",
        section("What is shown for a budget of splats", f'<div class="charts">{curve}</div>'),
        section(
            "Figures",
            table(["budget", "scene", "levels by", "splats shown", "PSNR", "SSIM", "worst view"], shown)
            + table(["scene", "bytes", "leaves", "splats of each level"], files),
        ),
        section("Worst view", f'<p>{text(caption)}</p><img src="{data_uri(picture)}" alt="{text(caption)}">'),
    ]
    return PAGE.substitute(title=text(report["a"]), accent=ACCENT, stage=STAGE, body="\n".join(sections))
