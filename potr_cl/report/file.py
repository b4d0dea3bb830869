"""What a .potr file holds and where its bytes are, as numbers and as a table."""

from __future__ import annotations

from typing import Any

from potr_cl.codec.container import Property, Section
from potr_cl.codec.decoder import PotrFile
from potr_cl.model.scene import SH_COEFFICIENTS

_GROUPS = {
    Property.METADATA: "metadata",
    Property.OCCUPANCY: "position: octree",
    Property.SEVERAL: "position: octree",
    Property.MULTIPLICITY: "position: octree",
    Property.TAIL_LENGTH: "position: tails",
    Property.TAIL: "position: tails",
    Property.SCALE: "scale",
    Property.ROTATION: "rotation",
    Property.OPACITY: "opacity",
}


def _group(section: Section) -> str:
    if section.kind != Property.SH:
        return _GROUPS[section.kind]
    coefficient = section.index // 3
    return "colour: DC" if coefficient == 0 else f"colour: AC degree {int(coefficient**0.5)}"


def file_report(file: PotrFile) -> dict[str, Any]:
    """Counts, parameters, bounding box and the bytes of each section.

    Raises:
        DataError: the positions or the metadata are damaged.
    """
    header = file.header
    metadata = file.metadata
    means = file.means()
    groups: dict[str, dict[str, float]] = {}
    for section in header.sections:
        entry = groups.setdefault(_group(section), {"serialised_bytes": 0, "bytes": 0})
        entry["serialised_bytes"] += section.raw_bytes
        entry["bytes"] += section.stored_bytes
    stored = sum(s.stored_bytes for s in header.sections)
    groups["header"] = {"serialised_bytes": len(file.data) - stored, "bytes": len(file.data) - stored}
    for entry in groups.values():
        entry["bits_a_splat"] = 8 * entry["bytes"] / header.splats
    # The original layout: position, normal, colours, opacity, scales, rotation, all float32.
    ply_bytes = 4 * header.splats * (14 + 3 * SH_COEFFICIENTS[header.sh_degree])
    source = metadata.get("source_bytes")
    return {
        "splats": header.splats,
        "sh_degree": header.sh_degree,
        "q": metadata.get("q"),
        "cameras": metadata.get("cameras"),
        "bounding_box": [means.min(axis=0).tolist(), means.max(axis=0).tolist()],
        "octree_levels": header.depth,
        "scale_factors": {
            "scale": header.sf_scale,
            "rotation": header.sf_rotation,
            "opacity": header.sf_opacity,
            "DC": header.sf_dc,
            "AC": header.sf_ac,
        },
        "gamma": metadata.get("gamma"),
        "beta": metadata.get("beta"),
        "delta_mse_max": metadata.get("delta_mse_max"),
        "lambda": metadata.get("lambda"),
        "alpha": metadata.get("alpha"),
        "coders": sorted({s.coder.name.lower() for s in header.sections}),
        "bytes": len(file.data),
        "bytes_a_splat": len(file.data) / header.splats,
        "ply_bytes": ply_bytes,
        "ratio_to_ply": ply_bytes / len(file.data),
        "source_splats": metadata.get("source_splats"),
        "source_bytes": source,
        "ratio_to_source": source / len(file.data) if isinstance(source, int) else None,
        "sections": groups,
    }


def format_report(report: dict[str, Any]) -> str:
    """The report as lines for people."""
    low, high = report["bounding_box"]
    lines = [
        f"splats          {report['splats']}",
        f"SH degree       {report['sh_degree']}",
        f"quality q       {'unknown' if report['q'] is None else report['q']}",
        f"cameras         {report['cameras'] or 'unknown or none'}",
        "bounding box    " + " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True)),
        f"octree levels   {report['octree_levels']}",
        "steps a unit    " + ", ".join(f"{name} {factor:g}" for name, factor in report["scale_factors"].items()),
        f"size            {report['bytes']} bytes, {report['bytes_a_splat']:.2f} a splat",
        f"as PLY          {report['ply_bytes']} bytes, {report['ratio_to_ply']:.1f} times as much",
    ]
    if report["ratio_to_source"] is not None:
        lines.append(f"source file     {report['source_bytes']} bytes, {report['ratio_to_source']:.1f} times as much")
    lines += ["", f"{'section':<22}{'serialised':>12}{'bytes':>12}{'bits a splat':>14}{'share':>8}"]
    for name, entry in report["sections"].items():
        lines.append(
            f"{name:<22}{entry['serialised_bytes']:>12}{entry['bytes']:>12}{entry['bits_a_splat']:>14.2f}"
            f"{100 * entry['bytes'] / report['bytes']:>7.1f}%"
        )
    return "\n".join(lines)
