"""What a file of a scene holds, and what looks wrong with it: :func:`info`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from potr_cl.api.inputs import SceneSource, bytes_of_source, encoded_bytes, holds_potr, name_of, scene_of
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.formats import load_scene, registry
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.page import POTR
from potr_cl.formats.scenes.scene_files import noting_mends, without_level
from potr_cl.formats.streams import plain
from potr_cl.model.scene import CleanReport, Scene
from potr_cl.report.file import file_report, format_report
from potr_cl.report.scene import format_histograms, format_scene, format_suspicious, scene_report


@dataclass(frozen=True, repr=False)
class SceneInfo:
    """What a scene holds; printed, it is the table that the command ``info`` shows.

    Attributes:
        facts: by name, ready for JSON: those of :func:`potr_cl.report.scene.scene_report` with ``file``, ``format`` and
            ``bytes``; of a .potr file also those of :func:`potr_cl.report.file.file_report`.
    """

    facts: dict[str, Any]

    @property
    def suspicious(self) -> list[str]:
        """What looks wrong, a line each."""
        return [entry["said"] for entry in self.facts["suspicious"]]

    def __getitem__(self, name: str) -> Any:
        return self.facts[name]

    def __repr__(self) -> str:
        facts = self.facts
        size = "" if facts["bytes"] is None else f", {facts['bytes']:,} bytes"
        wrong = f"{len(self.suspicious)} suspicious" if self.suspicious else "nothing suspicious"
        kind = facts["format"] or "in memory"
        return f"SceneInfo({kind}, {facts['splats']:,} splats of SH degree {facts['sh_degree']}{size}, {wrong})"

    def __str__(self) -> str:
        facts = self.facts
        if "sections" in facts:
            return "\n".join([format_report(facts), "", *format_histograms(facts), "", *format_suspicious(facts)])
        head = [f"format          {facts['format']}"] if facts["format"] else []
        if facts["bytes"] is not None:
            head.append(f"size            {facts['bytes']:,} bytes, {facts['bytes'] / facts['splats']:.2f} per splat")
        return "\n".join([*head, format_scene(facts)])


def info(file: SceneSource, trust: bool = False) -> SceneInfo:
    """What a scene holds, and what looks wrong with it, as the command ``info`` tells.

    Args:
        file: of any format that is read, or a scene in memory.
        trust: as of :func:`potr_cl.load_scene`.

    Raises:
        UsageError, DataError: as :func:`potr_cl.load_scene`.
    """
    own = {"file": str(name_of(file)), "format": None, "bytes": bytes_of_source(file)}
    told = {"trust": True} if trust else {}
    data = encoded_bytes(file)
    if data is not None:
        return SceneInfo({**own, **_file_facts(open_file(data, trust))})
    if not isinstance(file, (str, os.PathLike)):
        scene, mended = _as_it_would_be_read(file if isinstance(file, Scene) else scene_of(file))
        return SceneInfo({**own, **scene_report(scene, mended)})
    # A gzipped file is unpacked once, for both to tell its format and to read it.
    with plain(Path(file), trust) as path:
        kind = _format_of(path)
        if kind is POTR:
            return SceneInfo({**own, **_file_facts(open_file(path, trust))})
        with noting_mends() as mends:
            scene = load_scene(path, **told)
        return SceneInfo({**own, "format": kind.name, **scene_report(scene, mends)})


def _file_facts(opened: PotrFile) -> dict[str, Any]:
    """Two reports of one file: what it says itself of counts and bounds is the same as what the scene says."""
    return {"format": POTR.name, **file_report(opened), **scene_report(opened.scene())}


def _as_it_would_be_read(scene: Scene) -> tuple[Scene, list[CleanReport]]:
    """A scene in memory, which nobody may have cleaned."""
    clean, report = scene.cleaned()
    return clean, [report]


def _format_of(path: Path) -> SceneFormat:
    """The format that reads a scene; .potr files are known by their content, whatever they are called.

    Raises:
        UsageError: there is none.
    """
    return POTR if holds_potr(path) or not os.path.lexists(without_level(path)) else registry.format_of(path)
