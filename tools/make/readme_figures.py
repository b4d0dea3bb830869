"""The figures of README.md: its table of sizes and times, and the sentences of it that tell measured figures.

``python -m tools.make.docs`` puts the table in; ``python -m tools.make.benchmark_pages --check`` says which sentences
are not as the results of docs/benchmarks have them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tools.make.benchmark_results import ROOT, Result, ResultError, load

README = ROOT / "README.md"
_GPU, _CPU = "NVIDIA H200, 32 processors", "Intel's CPU runtime, 2 processors"
#: Scenes as the table calls them.
_SCENES = {"lego": "lego (NeRF-Synthetic)", "plush": "plush (captured)"}


@dataclass(frozen=True)
class Figure:
    """A figure of a result, as a sentence shows it.

    Attributes:
        result: its name. row: cells by column that no other row has. column: that the figure is of.
        format: how it is written.
        sign: -1 where the sentence says in words that the figure is below 0.
    """

    result: str
    row: Mapping[str, Any]
    column: str
    format: str = ".0f"
    sign: int = 1

    def text(self, results: Mapping[str, Result]) -> str:
        """The figure.

        Raises:
            ResultError: there is no such row, or more than one.
        """
        value = _one(results, self.result, self.row)[self.column]
        return value if isinstance(value, str) else format(self.sign * value, self.format)


def _of(result: str, column: str, form: str = ".0f", **row: Any) -> Figure:
    return Figure(result, row, column, form)


def _against_paper(scene: str, preset: str) -> Figure:
    row = {"scene": scene, "preset": preset, "q": 0.5}
    return Figure("rate_distortion/against_paper", row, "bytes at equal PSNR", sign=-1)


def _virtual(scene: str) -> Figure:
    return _of("virtual_cameras/qualities", "bytes at equal PSNR", scene=scene, q=0.5)


def _smaller(table: str, other: str) -> Figure:
    return _of(f"other_formats/{table}", "times smaller at that loss", ".1f", format=other)


def _with_photographs(q: float, column: str, form: str, sign: int = 1) -> Figure:
    return Figure("photographs/lego", {"preset": "smallest with photographs", "q": q}, column, form, sign)


_TUNED, _PLAIN = "C3DGS, fine-tuned *", "C3DGS *"
#: What README.md says, with figures put in; line ends are spaces.
SENTENCES: Sequence[tuple[str, Sequence[Figure]]] = (
    ("the file is {} to {} % larger at the same quality", (_virtual("lego"), _virtual("plush"))),
    ("files take {} (lego) and {} % (plush) more bytes at equal PSNR", (_virtual("lego"), _virtual("plush"))),
    (
        "lego's file of {} MB is {} dB *nearer*",
        (_with_photographs(0.5, "size", ".2f"), _with_photographs(0.5, "lost", ".2f", sign=-1)),
    ),
    (
        "at quality 0.3 one of {} MB, {} times smaller, loses {} dB",
        (
            _with_photographs(0.3, "size", ".2f"),
            _with_photographs(0.3, "times smaller", ".0f"),
            _with_photographs(0.3, "lost", ".2f"),
        ),
    ),
    (
        "On the CPU plush has {} dB",
        (_of("whole_commands/commands", "PSNR on test views", ".1f", scene="plush", preset="best", device=_CPU),),
    ),
    (
        "on the H200 the whole command takes {} and {} s",
        [
            _of("whole_commands/commands", "whole command", ".1f", scene=scene, preset="best", device=_GPU)
            for scene in _SCENES
        ],
    ),
    (
        "lego is at least {} and plush {} times smaller than that format's file. With preset `smallest` it is {} and "
        "{} times. With the training photographs, which one of these formats has seen too, it is {} and {} times.",
        (
            _smaller("lego", _TUNED),
            _smaller("plush", _PLAIN),
            _smaller("smallest_lego", _TUNED),
            _smaller("smallest_plush", _PLAIN),
            _smaller("photographs_lego", _TUNED),
            _smaller("photographs_plush", "MesonGS *"),
        ),
    ),
    (
        "As `.spz` they take {} and {} MB",
        [_of(f"other_formats/{scene}", "size", ".2f", format=".spz") for scene in _SCENES],
    ),
    (
        "That takes {} (lego) and {} % (plush) off what the paper's method (`--preset paper`) needs for the PSNR of "
        "the first two rows, preset `smallest` {} and {} % for that of the others",
        [_against_paper(scene, preset) for preset in ("best", "smallest") for scene in _SCENES],
    ),
    (
        "Without extras it takes {} MB of disk, `[intel-cpu]` {} MB more, `[pocl]` {} MB, `[convert]` {} MB",
        [
            Figure("install/sizes", {"": name}, "size")
            for name in (
                "the package without extras",
                *(f"extra `{extra}`, besides" for extra in ("intel-cpu", "pocl", "convert")),
            )
        ],
    ),
    (
        "about {} bytes a splat, most of it the re-fit's, and {} bytes a splat and view",
        [
            Figure("memory/growth_fit", {"peak": "host"}, column)
            for column in ("bytes a splat", "bytes a splat and view")
        ],
    ),
    ("`[view]` {} MB", (Figure("install/sizes", {"": "extra `view`, besides"}, "size"),)),
)


def figures_table() -> str:
    """The table at the beginning of the README: sizes, losses and times at quality 0.5."""
    results = load()
    lines = [
        "| at quality 0.5 | PLY | `.potr` | | PSNR against uncompressed | lost on the photographs | encoded in, H200 "
        "| 2 CPU cores |",
        "|---" * 8 + "|",
    ]
    for preset in ("best", "smallest"):
        for scene, name in _SCENES.items():
            uncompressed = _one(results, "rate_distortion/uncompressed", {"scene": scene})
            file = _one(results, f"rate_distortion/{scene}", {"preset": preset, "q": 0.5})
            cells = [
                name if preset == "best" else f"{scene}, `--preset {preset}`",
                f"{uncompressed['PLY bytes'] / 1e6:.1f} MB",
                f"{file['size']:.2f} MB",
                f"{file['times smaller']:.0f} × smaller",
                f"{file['PSNR against uncompressed']:.1f} dB",
                f"{file['lost']:.2f} dB of {uncompressed['PSNR against photographs']:.2f}",
                *(_encode_time(results["whole_commands/commands"], scene, preset, device) for device in (_GPU, _CPU)),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def wrong_sentences(results: Mapping[str, Result], text: str) -> list[str]:
    """Sentences with figures of results that a text, README.md, does not have."""
    words = " ".join(text.split())
    wanted = [sentence.format(*(figure.text(results) for figure in figures)) for sentence, figures in SENTENCES]
    return [f"{README}: does not say '{sentence}'" for sentence in wanted if not _says(words, sentence)]


def _says(words: str, sentence: str) -> bool:
    """Whether a text has a sentence, with no digit before or after it."""
    return re.search(rf"(?<![\d.]){re.escape(sentence)}(?!\d)", words) is not None


def _encode_time(commands: Result, scene: str, preset: str, device: str) -> str:
    wanted = {"scene": scene, "preset": preset, "device": device}
    for row in commands.records():
        if all(row[key] == value for key, value in wanted.items()):
            seconds = row["encode"]
            if seconds >= 120:
                return f"{seconds / 60:.0f} min"
            return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return ""


def _one(results: Mapping[str, Result], name: str, wanted: Mapping[str, Any]) -> dict[str, Any]:
    rows = [row for row in results[name].records() if all(row[key] == value for key, value in wanted.items())]
    if len(rows) != 1:
        raise ResultError(f"'{name}' has {len(rows)} rows with {dict(wanted)}, not one")
    return rows[0]
