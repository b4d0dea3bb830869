"""What travels between a Dask cluster and the computer that uses it, by what it is for.

    python -m tools.bench.traffic SCENE [--workers N] [--views N] [--iterations N] [--as-large] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json, such as tools.make.city writes, or two files. The cluster's
workers are processes of this computer, each with its best device. Prints for each command of the workers how many
answers came and the bytes either way, and the processors' time of this process and of the workers: bytes are the same
on any machine, so they need no quiet one.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import os
from pathlib import Path

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.pruning import visible_parts
from potr_cl.workers.cluster import ClusterPool
from potr_cl.workers.pool import Went
from tools.results import Column, Results


def seconds_of() -> float:
    """Processor time of this process by now."""
    return sum(os.times()[:2])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("cameras", type=Path, nargs="?", help="of a SCENE that is no folder")
    parser.add_argument("--workers", type=int, default=2, metavar="N")
    parser.add_argument("--views", type=int, metavar="N", help="the first N training views; default: all")
    parser.add_argument("--iterations", type=int, metavar="N", help="of pruning; default: the preset's")
    parser.add_argument("--as-large", action="store_true", help="share a scene of any size out as a large one")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    from distributed import Client, LocalCluster  # an extra of the package

    folder = args.scene.is_dir()
    scene = load_scene(args.scene / "point_cloud.ply" if folder else args.scene)
    views = train_views(load_cameras(args.scene / "cameras.json" if folder else args.cameras))[: args.views]
    options = dataclasses.replace(EncodeOptions.for_preset("best", between=False), cameras_anyway=True)
    if args.iterations is not None:
        options = options.changed(prune={"iterations": args.iterations})
    if args.as_large:
        visible_parts.LEAST_SPLATS = 1
    device = Device()
    results = Results(device.info, args.json)
    table = results.table(
        "traffic",
        f"Bytes between a cluster of {args.workers} workers and its user: {len(scene):,} splats, {len(views)} views "
        f"{views[0].width} wide",
        Column("for"),
        Column("answers", "", ".0f"),
        Column("sent", "MB", ",.2f"),
        Column("came back", "MB", ",.2f"),
    )
    workers = {"n_workers": args.workers, "threads_per_worker": 1, "memory_limit": None, "dashboard_address": None}
    with (
        LocalCluster(**workers) as cluster,
        Client(cluster, set_as_default=False) as client,
        ClusterPool(cluster.scheduler_address, device) as pool,
    ):
        before = sum(client.run(seconds_of).values())
        own = seconds_of()
        found = encode(scene, views, options, device=device, pool=pool)
        own = seconds_of() - own
        there = sum(client.run(seconds_of).values()) - before
        traffic = pool.traffic
    every = [*traffic.of.items(), ("all", Went(0, traffic.sent, traffic.received))]
    for what, went in every:
        table.add(what, went.answers or None, went.sent / 1e6, went.received / 1e6)
    times = results.table(
        "times", "Processor time", Column("of"), Column("time", "s", ".1f"), Column("splats left", "", ",.0f")
    )
    times.add("this computer", own, len(found.order))
    times.add("workers", there, None)
    print(hashlib.sha256(found.data).hexdigest())


if __name__ == "__main__":
    main()
