"""What a scene does not need, and what leaving it out saves.

    python -m tools.bench.needs [SCENE …] [--views N]

Each line compares two runs of the same work, in turn: with and without what is skipped where that can be switched, and
else of the scene and of the scene with so much more of what nobody needs: then the ratio says what the skip leaves to
be paid. A SCENE is a folder with point_cloud.ply and cameras.json; the bundled excerpt by default. Times are the
clock's, each the best of some; only their ratios mean anything on a machine that does other things. Prints Markdown.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.workloads import excerpt

#: ΔMSE_MAX at q = 0.5.
DELTA_MSE_MAX = EncodeOptions.for_preset("paper").parameters.delta_mse_max


@dataclasses.dataclass(frozen=True)
class Line:
    """What is skipped, what two runs are compared, their costs, and what the costs are in."""

    skipped: str
    lean: str
    full: str
    costs: tuple[float, float]
    unit: str = "s"


def in_turn(repeats: int, *works: Callable[[], Any]) -> tuple[float, ...]:
    """Seconds of each, the best of some rounds, after one that is not counted."""
    best = [np.inf] * len(works)
    for number in range(repeats + 1):
        for i, work in enumerate(works):
            started = time.perf_counter()
            work()
            if number:
                best[i] = min(best[i], time.perf_counter() - started)
    return tuple(best)


def more(scene: Scene, **changes: Any) -> Scene:
    """The scene and as many splats again, with changes."""
    other = dataclasses.replace(scene, **changes)
    return Scene(
        np.concatenate([scene.means, other.means]),
        np.concatenate([scene.log_scales, other.log_scales]),
        np.concatenate([scene.quaternions, other.quaternions]),
        np.concatenate([scene.opacity_logits, other.opacity_logits]),
        np.concatenate([scene.sh, other.sh]),
    )


def looking_away(camera: Camera) -> Camera:
    """The same camera centre, looking the other way."""
    turn = np.diag([-1.0, 1.0, -1.0])
    return dataclasses.replace(
        camera, name=f"{camera.name} away", rotation=turn @ camera.rotation, translation=turn @ camera.translation
    )


class Needs:
    """One scene on one device."""

    def __init__(self, scene: Scene, views: Sequence[Camera], device: Device, repeats: int, iterations: int) -> None:
        self.scene, self.views, self.device = scene, list(views), device
        self.repeats, self.iterations = repeats, iterations

    def encode(self, scene: Scene, views: Sequence[Camera] | None = None, **changes: Any) -> int:
        """Bytes of an encode."""
        options = EncodeOptions.for_preset("paper", **{"prune": {"iterations": self.iterations}, **changes})
        return encode(scene, views or self.views, options, device=self.device).nbytes

    def schedule(self, sweep: SweepOptions, threshold: float = DELTA_MSE_MAX) -> tuple[float, int]:
        """The pruning alone: sweeps of all tiles that it took, and iterations."""
        with Rasterizer(self.device, self.scene) as rasterizer, RemovalSweep(rasterizer, self.views, sweep) as removal:
            pruned = prune_scene(removal, PruningOptions(threshold, self.iterations))
            swept = removal.sweeps
        return swept, pruned.iterations

    def render(self, rasterizer: Rasterizer) -> None:
        """All views, pictures left on the device."""
        for camera in self.views:
            rasterizer.render_device(camera)

    def two_schedules(self, lean: SweepOptions, full: SweepOptions) -> tuple[float, float]:
        """Seconds of two schedules."""
        seconds = in_turn(self.repeats, lambda: self.schedule(lean), lambda: self.schedule(full))
        return seconds[0], seconds[1]

    def two_encodes(self, lean: Callable[[], int], full: Callable[[], int]) -> tuple[float, float]:
        """Seconds of two encodes."""
        seconds = in_turn(self.repeats, lean, full)
        return seconds[0], seconds[1]

    def two_renders(self, lean: Scene, full: Scene) -> tuple[float, float]:
        """Seconds of rendering all views of two scenes."""
        with Rasterizer(self.device, lean) as one, Rasterizer(self.device, full) as other:
            seconds = in_turn(self.repeats, lambda: self.render(one), lambda: self.render(other))
        return seconds[0], seconds[1]

    def lines(self) -> Iterator[Line]:
        """Everything, one after the other."""
        yield from self.of_the_scene()
        yield from self.of_the_schedule()
        yield from self.of_the_file()
        yield from self.nothing_at_all()

    def of_the_scene(self) -> Iterator[Line]:
        """Splats, views and coefficients that do nothing."""
        scene = self.scene
        bare = dataclasses.replace(scene, sh=np.ascontiguousarray(scene.sh[:, :1]))
        whole, encoded = "the scene", "encode"
        yield Line(
            "SH of degrees that the scene has not",
            "degree 0, render",
            "degree 3, render",
            self.two_renders(bare, scene),
        )
        yield Line(
            "compaction of degree 0",
            "degree 0, encode",
            "degree 3, encode",
            self.two_encodes(lambda: self.encode(bare), lambda: self.encode(scene)),
        )
        radius = float(np.abs(scene.means - scene.means.mean(axis=0)).max())
        unseen = more(scene, means=scene.means + np.array([1e4 * radius, 0, 0], np.float32))
        yield Line(
            "unseen splats",
            f"{whole}, {encoded}",
            "and as many that no view sees",
            self.two_encodes(lambda: self.encode(scene), lambda: self.encode(unseen)),
        )
        transparent = more(scene, opacity_logits=np.full(len(scene), -6, np.float32))
        yield Line(
            "transparent splats (alpha below 1/255)",
            f"{whole}, render",
            "and as many transparent ones",
            self.two_renders(scene, transparent),
        )
        away = [*self.views, *(looking_away(camera) for camera in self.views)]
        yield Line(
            "views that see nothing",
            f"{whole}, {encoded}",
            "and as many views that look away",
            self.two_encodes(lambda: self.encode(scene), lambda: self.encode(scene, away)),
        )
        small = more(scene, log_scales=scene.log_scales - np.float32(np.log(100)))
        yield Line(
            "sub-pixel splats: not skipped",
            f"{whole}, render",
            "and as many a hundredth as large",
            self.two_renders(scene, small),
        )
        device = Device(self.device.info, profiling=True)
        camera = self.views[0]
        depth = scene.means @ camera.rotation[2].astype(np.float32)
        sort = []
        for ordered in (scene.subset(np.argsort(depth)), scene):
            with Rasterizer(device, ordered) as rasterizer:
                best = np.inf
                for _ in range(self.repeats + 1):
                    device.stage_times()
                    rasterizer.render_device(camera)
                    best = min(best, device.stage_times()["sort_tiles"])
            sort.append(best)
        yield Line(
            "sorting what is in order: not skipped",
            "splats in order of depth, sort",
            "in the file's order",
            (sort[0], sort[1]),
        )

    def of_the_schedule(self) -> Iterator[Line]:
        """What a measurement does not compute again."""
        default = SweepOptions()
        for label, tolerance in (("0", 0.0), (f"{default.tolerance:g} (default)", default.tolerance)):
            lean = dataclasses.replace(default, tolerance=tolerance)
            always = dataclasses.replace(default, tolerance=-1)
            yield Line(
                "unchanged and hardly changed tiles",
                f"tolerance {label}",
                "every tile every time",
                (self.schedule(lean)[0], self.schedule(always)[0]),
                "sweeps",
            )
            yield Line("the same", f"tolerance {label}", "every tile", self.two_schedules(lean, always))
        tightened = (dataclasses.replace(default, tighten=on) for on in (True, False))
        costs = self.two_schedules(*tightened)
        yield Line("intersections that reach no pixel", "lists tightened", "not tightened", costs)
        costs = self.two_schedules(default, dataclasses.replace(default, transmittance_threshold=1e-30))
        yield Line(
            "what stands behind ended pixels", f"ends at {default.transmittance_threshold:g}", "ends at 1e-30", costs
        )
        costs = self.two_schedules(default, dataclasses.replace(default, memory=0))
        yield Line("projections and lists made before", "kept (default)", "made again", costs)
        settled = self.schedule(default, threshold=0.0)[1]
        yield Line(
            "iterations with nothing left to decide",
            "ΔMSE_MAX 0: iterations run",
            "asked for",
            (settled, self.iterations),
            "iterations",
        )

    def of_the_file(self) -> Iterator[Line]:
        """Streams without content."""
        scene, parameters = self.scene, EncodeOptions.for_preset("best").parameters
        bare = dataclasses.replace(scene, sh=np.ascontiguousarray(scene.sh[:, :1]))
        zero, grey = (dataclasses.replace(scene, sh=scene.sh.copy()) for _ in range(2))
        zero.sh[:, 1:] = 0
        grey.sh[:] = grey.sh.mean(axis=2, keepdims=True)
        files = [b"".join(code_scene(s, parameters, self.views).pieces) for s in (bare, zero, grey, scene)]
        sizes = [float(len(data)) for data in files]
        yield Line("bands that are all zero", "degree 0", "degree 3, AC all zero", (sizes[0], sizes[1]), "bytes")
        seconds = in_turn(self.repeats, lambda: decode(files[0]), lambda: decode(files[1]))
        yield Line("the same", "degree 0, decode", "AC all zero, decode", (seconds[0], seconds[1]))
        yield Line("channels that are all zero", "grey", "coloured", (sizes[2], sizes[3]), "bytes")
        seconds = in_turn(self.repeats, lambda: decode(files[2]), lambda: decode(files[3]))
        yield Line("the same", "grey, decode", "coloured, decode", (seconds[0], seconds[1]))

    def nothing_at_all(self) -> Iterator[Line]:
        """A scene that needs no stage: pruned until nothing goes any more, degree 0."""
        bare = dataclasses.replace(self.scene, sh=np.ascontiguousarray(self.scene.sh[:, :1]))
        options = EncodeOptions.for_preset("paper", prune={"iterations": self.iterations})
        needless, before = bare, len(bare) + 1
        while len(needless) < before:  # without its least splats a scene may have others to spare
            before = len(needless)
            needless = needless.subset(np.sort(encode(needless, self.views, options, device=self.device).order))
        costs = self.two_encodes(
            lambda: self.encode(needless, prune=False, compact=False), lambda: self.encode(needless)
        )
        yield Line("all of it: a pruned scene of degree 0", "--no-prune --no-compact", "full encode", costs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE")
    parser.add_argument("--views", type=int, default=8, metavar="N", help="of the training views, spread evenly")
    parser.add_argument("--iterations", type=int, default=Prune.iterations)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    with tempfile.TemporaryDirectory() as scratch:
        for folder in args.scenes or [excerpt(Path(scratch) / "excerpt")]:
            scene = load_scene(folder / "point_cloud.ply")
            views = train_views(load_cameras(folder / "cameras.json"))
            views = views[:: max(len(views) // args.views, 1)][: args.views]
            print(f"\n### {folder.name}: {len(scene):,} splats, {len(views)} views, {device.info}\n")
            print("| what is skipped | one | other | cost of the one | of the other | one / other |")
            print("|---|---|---|---|---|---|")
            for line in Needs(scene, views, device, args.repeats, args.iterations).lines():
                one, other = line.costs
                texts = (
                    f"{cost:,.0f}" if line.unit in ("bytes", "iterations") else f"{cost:.3g}" for cost in line.costs
                )
                cells = (line.skipped, line.lean, line.full, *(f"{text} {line.unit}" for text in texts))
                print(f"| {' | '.join(cells)} | {one / other:.2f} |", flush=True)


if __name__ == "__main__":
    main()
