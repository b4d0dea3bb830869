"""What a file's report says of its sections: streams, integers and bytes are three different things."""

from __future__ import annotations

import json
from functools import cache

import pytest

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.report.file import file_report, format_report
from tests.reference.scenes import random_scene

#: Enough for the context coder to be taken without trying others.
SPLATS = 33_000
#: Streams of one integer a splat in a scene of SH degree 1.
STREAMS = {
    "scale": 3,
    "rotation": 3,
    "opacity": 1,
    "colour: DC": 3,
    "colour: AC degree 1": 9,
}


@cache
def report_of(preset, entropy):
    parameters = HyperParameters.from_quality(0.5, preset)
    pieces = code_scene(random_scene(SPLATS, 1), parameters, metadata=b'{"q": 0.5}', entropy=entropy).pieces
    return file_report(open_file(b"".join(pieces)))


@pytest.mark.parametrize(("preset", "coder"), [("best", "bundles"), ("best", "zstd"), ("paper", "zstd")])
def test_streams_and_integers(preset, coder):
    sections = report_of(preset, EntropyCoder(coder, 1))["sections"]
    assert {name: sections[name]["streams"] for name in STREAMS} == STREAMS
    for name, streams in STREAMS.items():
        assert sections[name]["integers"] == SPLATS * streams
        assert set(sections[name]["coders"]) <= {coder, "raw"}
    assert sections["metadata"]["integers"] == sections["metadata"]["serialised_bytes"] == 10
    assert sections["header"]["streams"] == sections["header"]["integers"] == 0


def test_what_bundles_hold_was_never_serialised_and_what_zstd_packs_are_whole_integers():
    bundles, zstd = (report_of("best", EntropyCoder(name, 1)) for name in ("bundles", "zstd"))
    for name in STREAMS:
        assert bundles["sections"][name]["coders"] == ["bundles"]
        assert bundles["sections"][name]["serialised_bytes"] is None
        entry = zstd["sections"][name]
        assert entry["integers"] <= entry["serialised_bytes"] <= 4 * entry["integers"]
        assert entry["bytes"] <= entry["serialised_bytes"]
    octree = bundles["sections"]["position: octree"]
    assert octree["serialised_bytes"] >= octree["bytes"]
    # Scales of the paper's steps take two bytes each.
    paper = report_of("paper", EntropyCoder("zstd", 1))["sections"]["scale"]
    assert paper["serialised_bytes"] == 2 * paper["integers"] + 3
    for report in (bundles, zstd):
        assert json.loads(json.dumps(report)) == report
        assert sum(entry["bytes"] for entry in report["sections"].values()) == report["bytes"]
        bits = sum(entry["bits_a_splat"] for entry in report["sections"].values())
        assert bits == pytest.approx(8 * report["bytes_a_splat"])


def row(report, name):
    line = next(line for line in format_report(report).splitlines() if line.startswith(name))
    return line.removeprefix(name).split()


def test_the_table_for_people():
    bundles, zstd = (report_of("best", EntropyCoder(name, 1)) for name in ("bundles", "zstd"))
    titles = row(bundles, "section")
    assert titles[:5] == ["coder", "streams", "integers", "serialised", "bytes"]
    for report, coder in ((bundles, "bundles"), (zstd, "zstd")):
        entry = report["sections"]["rotation"]
        cells = row(report, "rotation")
        assert cells[:3] == [coder, "3", f"{3 * SPLATS:,}"]
        assert cells[3] == ("-" if coder == "bundles" else f"{entry['serialised_bytes']:,}")
        assert cells[4] == f"{entry['bytes']:,}"
