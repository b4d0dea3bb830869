"""What a .potr file holds and where its bytes are, as numbers and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from potr_cl.codec.blocks.file import BlockedFile
from potr_cl.codec.container import Header
from potr_cl.codec.decoder import AnyFile, PotrFile
from potr_cl.codec.sections import Property, Section
from potr_cl.model.box import Box
from potr_cl.model.scene import SH_COEFFICIENTS
from potr_cl.plain_text import plain_fact

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
    Property.STEPS: "colour: steps",
}

#: A line of the table of sections.
_ROW = "{:<22}{:<14}{:>8}{:>12}{:>12}{:>12}{:>14}{:>8}"


_BLOCK_ROW = "{:<10}{:>10}{:>12}{:>14}  {}"
#: Blocks that the table for people lists.
_MOST_BLOCKS = 40


def _group(section: Section) -> str:
    if section.kind != Property.SH:
        return _GROUPS[section.kind]
    coefficient = section.index // 3
    return "colour: DC" if coefficient == 0 else f"colour: AC degree {int(coefficient**0.5)}"


def _contents(sections: Sequence[Section]) -> dict[str, Any]:
    """What some sections hold and take; no serialised size where integers are coded without being bytes first."""
    raw = [section.raw_bytes for section in sections]
    return {
        "coders": sorted({section.coder.name.lower() for section in sections}),
        "streams": sum(section.streams for section in sections),
        "integers": sum(section.integers for section in sections),
        "serialised_bytes": None if None in raw else sum(size for size in raw if size is not None),
        "bytes": sum(section.stored_bytes for section in sections),
    }


def _colour_steps(file: PotrFile) -> dict[str, Any] | None:
    """The numbers of the rule that fits the steps of colours to each splat; None where there is none."""
    steps = file.colour_steps()
    if steps is None:
        return None
    return {
        "splats_a_group": 1 << steps.group_bits,
        "exponents": [power / 16 for power in steps.powers],
        "scales": list(steps.scales),
        "opacities": list(steps.opacities),
        "groups": len(steps.groups),
    }


def file_report(file: AnyFile) -> dict[str, Any]:
    """Counts, parameters, bounding box, and what the sections hold and take.

    Of each group of sections: the coders; the number of streams and of integers in them (bytes, for streams of bytes);
    the size of these as bytes before the coder, None where the context coder codes integers as they are; and the size
    in the file. Of the header the sizes alone.

    Raises:
        DataError: the positions, the steps of colours or the metadata are damaged.
    """
    if isinstance(file, BlockedFile):
        return _report_of_blocks(file)
    means = file.means()
    bounds = Box.of([*means.min(axis=0), *means.max(axis=0)])
    header_bytes = len(file.data) - sum(section.stored_bytes for section in file.header.sections)
    return _report([file.header], file.metadata, bounds, len(file.data), header_bytes) | {
        "colour_steps": _colour_steps(file),
        "blocks": None,
    }


def _report_of_blocks(file: BlockedFile[PotrFile]) -> dict[str, Any]:
    headers = [file.header(number) for number in file.numbers()]
    size = file.table.file_bytes
    header_bytes = size - sum(section.stored_bytes for header in headers for section in header.sections)
    blocks = [
        {"splats": block.splats, "bytes": block.nbytes, "bounding_box": [list(block.box.low), list(block.box.high)]}
        for block in file.table.blocks
    ]
    return _report(headers, file.metadata, file.bounds, size, header_bytes) | {"colour_steps": None, "blocks": blocks}


def _report(
    headers: Sequence[Header], facts: dict[str, Any], bounds: Box, file_bytes: int, header_bytes: int
) -> dict[str, Any]:
    """What the headers of a file's blocks, or its only one, say together."""
    header = headers[0]
    splats = sum(each.splats for each in headers)
    # A file says of itself what it likes.
    metadata = {name: plain_fact(value) for name, value in facts.items()}
    grouped: dict[str, list[Section]] = {}
    for section in (section for each in headers for section in each.sections):
        grouped.setdefault(_group(section), []).append(section)
    groups = {name: _contents(sections) for name, sections in grouped.items()}
    groups["header"] = {
        "coders": [],
        "streams": 0,
        "integers": 0,
        "serialised_bytes": header_bytes,
        "bytes": header_bytes,
    }
    for entry in groups.values():
        entry["bits_a_splat"] = 8 * entry["bytes"] / splats
    # The original layout: position, normal, colours, opacity, scales, rotation, all float32.
    ply_bytes = 4 * splats * (14 + 3 * SH_COEFFICIENTS[header.sh_degree])
    source = metadata.get("source_bytes")
    return {
        "splats": splats,
        "sh_degree": header.sh_degree,
        "antialiased": header.antialiased,
        "low_pass": header.low_pass,
        "q": metadata.get("q"),
        "cameras": metadata.get("cameras"),
        "bounding_box": [list(bounds.low), list(bounds.high)],
        "octree_levels": max(each.depth for each in headers),
        "scale_factors": {
            "scale": header.sf_scale,
            "rotation": header.sf_rotation,
            "opacity": header.sf_opacity,
            "DC": header.sf_dc,
            "AC": header.sf_ac,
        },
        "colour_steps": None,
        "gamma": metadata.get("gamma"),
        "beta": metadata.get("beta"),
        "delta_mse_max": metadata.get("delta_mse_max"),
        "lambda": metadata.get("lambda"),
        "alpha": metadata.get("alpha"),
        "coders": sorted({s.coder.name.lower() for each in headers for s in each.sections}),
        "bytes": file_bytes,
        "bytes_a_splat": file_bytes / splats,
        "ply_bytes": ply_bytes,
        "ratio_to_ply": ply_bytes / file_bytes,
        "source_splats": metadata.get("source_splats"),
        "source_bytes": source,
        "ratio_to_source": source / file_bytes if isinstance(source, int) else None,
        "sections": groups,
    }


def antialiasing(report: dict[str, Any]) -> str:
    """How a scene is to be rendered, for people, from a report's ``antialiased`` and ``low_pass``."""
    return f"yes, low-pass filter of {report['low_pass']:g} square pixels" if report["antialiased"] else "no"


def _said_of_steps(steps: dict[str, Any] | None, sections: dict[str, Any]) -> str:
    if steps is None and _GROUPS[Property.STEPS] in sections:
        return "a splat's own, by a rule of each block"
    if steps is None:
        return "the same for all splats"
    dc, ac = steps["exponents"]
    return (
        f"a splat's own: its weight to the power of {dc:g} (DC) and {ac:g} (AC), from its scales, its opacity and "
        f"its group of {steps['splats_a_group']} splats"
    )


def format_report(report: dict[str, Any]) -> str:
    """The report as lines for people."""
    low, high = report["bounding_box"]
    lines = [
        f"splats          {report['splats']:,}",
        f"SH degree       {report['sh_degree']}",
        f"antialiased     {antialiasing(report)}",
        f"quality q       {'unknown' if report['q'] is None else report['q']}",
        f"cameras         {report['cameras'] or 'unknown or none'}",
        "bounding box    " + " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True)),
        f"octree levels   {report['octree_levels']}",
        "steps a unit    " + ", ".join(f"{name} {factor:g}" for name, factor in report["scale_factors"].items()),
        f"colour steps    {_said_of_steps(report['colour_steps'], report['sections'])}",
        f"size            {report['bytes']:,} bytes, {report['bytes_a_splat']:.2f} a splat",
        f"as PLY          {report['ply_bytes']:,} bytes, {report['ratio_to_ply']:.1f} times as much",
    ]
    if report["blocks"] is not None:
        least, most = (choose(block["splats"] for block in report["blocks"]) for choose in (min, max))
        lines.append(f"blocks          {len(report['blocks'])}, of {least:,} to {most:,} splats")
    if report["ratio_to_source"] is not None:
        lines.append(f"source file     {report['source_bytes']:,} bytes, {report['ratio_to_source']:.1f} times as much")
    lines += [
        "",
        _ROW.format("section", "coder", "streams", "integers", "serialised", "bytes", "bits a splat", "share"),
    ]
    for name, entry in report["sections"].items():
        serialised = entry["serialised_bytes"]
        lines.append(
            _ROW.format(
                name,
                ", ".join(entry["coders"]),
                entry["streams"] or "",
                f"{entry['integers']:,}" if entry["integers"] else "",
                "-" if serialised is None else f"{serialised:,}",
                f"{entry['bytes']:,}",
                f"{entry['bits_a_splat']:.2f}",
                f"{100 * entry['bytes'] / report['bytes']:.1f}%",
            )
        )
    if report["blocks"] is not None:
        lines += ["", _BLOCK_ROW.format("block", "splats", "bytes", "bits a splat", "bounding box")]
        for number, block in enumerate(report["blocks"][:_MOST_BLOCKS]):
            bits = f"{8 * block['bytes'] / block['splats']:.2f}"
            lines.append(
                _BLOCK_ROW.format(
                    number, f"{block['splats']:,}", f"{block['bytes']:,}", bits, str(Box(*block["bounding_box"]))
                )
            )
        if len(report["blocks"]) > _MOST_BLOCKS:
            lines.append(f"… and {len(report['blocks']) - _MOST_BLOCKS} more (--json lists all)")
    return "\n".join(lines)
