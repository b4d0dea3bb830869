"""What a .potr file holds and where its bytes are, as numbers and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from potr_cl.codec.body import Body
from potr_cl.codec.container import Block
from potr_cl.codec.decoder import PotrFile
from potr_cl.codec.levels import splats_of_levels
from potr_cl.codec.sections import Coder, Property, Section
from potr_cl.model.box import Box
from potr_cl.model.scene import SH_COEFFICIENTS
from potr_cl.plain_text import plain_fact

_GROUPS = {
    Property.METADATA: "metadata",
    Property.OCCUPANCY: "position: octree",
    Property.SEVERAL: "position: octree",
    Property.MULTIPLICITY: "position: octree",
    Property.LEAF_LEVEL: "position: tails",
    Property.TAIL: "position: tails",
    Property.SCALE: "scale",
    Property.ROTATION: "rotation",
    Property.OPACITY: "opacity",
    Property.STEPS: "colour: precision",
}

#: A line of the table of sections.
_ROW = "{:<22}{:<14}{:>8}{:>12}{:>12}{:>12}{:>14}{:>8}"


_BLOCK_ROW = "{:<10}{:>10}{:>12}{:>14}  {}"
#: Blocks that the table for people lists.
_MOST_BLOCKS = 40


def _group(section: Section) -> str:
    if section.kind is None:
        return section.name
    if section.kind.degree is not None:
        return f"colour: AC degree {section.kind.degree}" if section.kind.degree else "colour: DC"
    return _GROUPS[section.kind]


def _contents(sections: Sequence[tuple[Block | None, Section]]) -> dict[str, Any]:
    """What some sections hold and take; no serialised size where integers are coded without being bytes first."""
    coders, integers, serialised = set(), 0, True
    for block, section in sections:
        streams = section.kind.streams if section.kind else 0
        if block is not None and streams and block.coder == Coder.BUNDLES:
            coders.add("bundles")
            serialised = False
        else:
            coders.add("raw" if section.raw_bytes == section.stored_bytes else "zstd")
        integers += streams * block.splats if block is not None and streams else section.raw_bytes
    return {
        "coders": sorted(coders),
        "streams": sum(section.kind.streams or 1 if section.kind else 1 for _, section in sections),
        "integers": integers,
        "serialised_bytes": sum(section.raw_bytes for _, section in sections) if serialised else None,
        "bytes": sum(section.stored_bytes for _, section in sections),
    }


def _colour_steps(body: Body) -> dict[str, Any] | None:
    """The numbers of the rule that fits the steps of colours to each splat; None where there is none."""
    steps = body.colour_steps()
    if steps is None:
        return None
    return {
        "splats_a_group": 1 << steps.group_bits,
        "exponents": [power / 16 for power in steps.powers],
        "scales": list(steps.scales),
        "opacities": list(steps.opacities),
        "groups": len(steps.groups),
    }


def file_report(file: PotrFile) -> dict[str, Any]:
    """Counts, parameters, bounding box, and what the sections hold and take.

    Of each group of sections: the coders; the number of streams and of integers in them (bytes, for streams of bytes);
    the size of these as bytes before the coder, None where bundles code integers as they are; and the size in the file.
    Of the header the sizes alone.

    Raises:
        DataError: the steps of colours are damaged.
    """
    header, block = file.header, file.blocks[-1]
    # A file says of itself what it likes.
    metadata = {name: plain_fact(value) for name, value in file.metadata.items()}
    grouped: dict[str, list[tuple[Block | None, Section]]] = {}
    for section in header.sections:
        grouped.setdefault(_group(section), []).append((None, section))
    for each in file.blocks:
        for section in each.sections:
            grouped.setdefault(_group(section), []).append((each, section))
    groups = {name: _contents(sections) for name, sections in grouped.items()}
    own = header.start
    groups["header"] = {"coders": [], "streams": 0, "integers": 0, "serialised_bytes": own, "bytes": own}
    for entry in groups.values():
        entry["bits_a_splat"] = 8 * entry["bytes"] / header.splats
    # The original layout: position, normal, colours, opacity, scales, rotation, all float32.
    ply_bytes = 4 * header.splats * (14 + 3 * SH_COEFFICIENTS[header.sh_degree])
    source, bounds, many = metadata.get("source_bytes"), file.bounds, len(file.blocks) > 1
    return {
        "splats": header.splats,
        "sh_degree": header.sh_degree,
        "antialiased": block.antialiased,
        "low_pass": block.low_pass,
        "q": metadata.get("q"),
        "cameras": metadata.get("cameras"),
        "bounding_box": [list(bounds.low), list(bounds.high)],
        "octree_levels": max(each.depth for each in file.blocks),
        "scale_factors": {
            "scale": block.sf_scale,
            "rotation": block.sf_rotation,
            "opacity": block.sf_opacity,
            "DC": block.sf_dc,
            "AC": block.sf_ac,
        },
        "colour_steps": None if many else file.of(0, _colour_steps),
        "gamma": metadata.get("gamma"),
        "beta": metadata.get("beta"),
        "delta_mse_max": metadata.get("delta_mse_max"),
        "lambda": metadata.get("lambda"),
        "alpha": metadata.get("alpha"),
        "coders": sorted({coder for entry in groups.values() for coder in entry["coders"]}),
        "bytes": header.file_bytes,
        "bytes_a_splat": header.file_bytes / header.splats,
        "ply_bytes": ply_bytes,
        "ratio_to_ply": ply_bytes / header.file_bytes,
        "source_splats": metadata.get("source_splats"),
        "source_bytes": source,
        "ratio_to_source": source / header.file_bytes if isinstance(source, int) else None,
        "levels": file.levels,
        "level_splats": splats_of_levels(file),
        "level_errors": [file.blocks[file.header.of_level(level)[0]].error for level in range(file.levels)],
        "sections": groups,
        "blocks": [_block_report(each) for each in file.blocks] if many else None,
    }


def _block_report(block: Block) -> dict[str, Any]:
    return {
        "splats": block.splats,
        "level": block.level,
        "bytes": block.nbytes,
        "bounding_box": [list(block.box.low), list(block.box.high)],
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
        f"size            {report['bytes']:,} bytes, {report['bytes_a_splat']:.2f} per splat",
        f"as PLY          {report['ply_bytes']:,} bytes, {report['ratio_to_ply']:.1f} times as much",
    ]
    if report["blocks"] is not None:
        least, most = (choose(block["splats"] for block in report["blocks"]) for choose in (min, max))
        lines.append(f"blocks          {len(report['blocks'])}, of {least:,} to {most:,} splats")
    if report["levels"] > 1:
        lines += [
            f"{'' if level else 'levels':<16}{level}: {splats:,} splats" + (f", error {error:.3g}" if level else "")
            for level, (splats, error) in enumerate(zip(report["level_splats"], report["level_errors"], strict=True))
        ]
    if report["ratio_to_source"] is not None:
        lines.append(f"source file     {report['source_bytes']:,} bytes, {report['ratio_to_source']:.1f} times as much")
    lines += [
        "",
        _ROW.format("section", "coder", "streams", "integers", "serialised", "bytes", "bits/splat", "share"),
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
        lines += ["", _BLOCK_ROW.format("block", "splats", "bytes", "bits/splat", "bounding box")]
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
