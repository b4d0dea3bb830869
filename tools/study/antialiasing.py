"""What is lost if an antialiased scene is encoded as if it were a classic one, and how fine its scales must be.

    python -m tools.study.antialiasing SCENE … [--qualities Q …] [--preset NAME] [--json FILE]
    python -m tools.study.antialiasing SCENE … --scale-steps X … [--preset NAME] [--json FILE]

Each scene is taken as an antialiased one, whatever it was trained as. The first command encodes it twice: as what it
is, and as a classic scene, whose pictures the encoder then compares, prunes by and re-fits to. Both files are judged as
they will be looked at: PSNR is the mean over the test views, rendered with antialiasing, against the uncompressed
scene's. What a scene loses by being shown the wrong way, before anything is compressed, is said in the title.

The second one encodes it at quality 0.5 with X times as many steps of the scales as a classic scene has.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from potr_cl.codec.decoder import open_file
from potr_cl.codec.quantisers import ANTIALIASED_SCALE_STEPS
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import DEFAULT, PRESETS
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scene_parser

QUALITIES = (0.3, 0.5, 0.7)

_FIGURES = (("splats", "", ","), ("bytes", "", ","), ("PSNR", "dB", ".2f"))


class Judge:
    """Encodes a scene and looks at the file, antialiased, from the test views."""

    def __init__(self, device: Device, scene: Scene, cameras: Sequence[Camera]) -> None:
        self._device, self._views, self._judges = device, train_views(cameras), test_views(cameras)
        self._wanted = pictures(device, scene.rendered(True), self._judges)

    def encoded(self, scene: Scene, options: EncodeOptions) -> tuple[int, int, float]:
        """Splats, bytes and PSNR of the file."""
        encoded = encode(scene, self._views, options, device=self._device)
        decoded = open_file(b"".join(encoded.pieces)).scene()
        return len(decoded), encoded.nbytes, self.psnr(decoded.rendered(True))

    def psnr(self, scene: Scene) -> float:
        """Mean over the views, as the scene says that it is rendered."""
        shown = pictures(self._device, scene, self._judges)
        return float(np.mean([psnr(a, b) for a, b in zip(self._wanted, shown, strict=True)]))


def against_classic(
    results: Results, name: str, scene: Scene, judge: Judge, options: EncodeOptions, qualities: Sequence[float]
) -> None:
    """The table of files that were encoded as what the scene is and as a classic one."""
    table = results.table(
        name,
        f"{name} as an antialiased scene, preset {options.preset}; rendered as a classic one, uncompressed, it is "
        f"{judge.psnr(scene.rendered(False)):.1f} dB from itself",
        Column("q", format="g"),
        *(
            Column(f"as {kind}: {what}", unit, form)
            for kind in ("antialiased", "classic")
            for what, unit, form in _FIGURES
        ),
    )
    for q in qualities:
        figures = [judge.encoded(scene.rendered(kind), dataclasses.replace(options, q=q)) for kind in (True, False)]
        table.add(q, *(figure for each in figures for figure in each))


def by_scale_steps(
    results: Results, name: str, scene: Scene, judge: Judge, options: EncodeOptions, multiples: Sequence[float]
) -> None:
    """The table of files by how fine the steps of their scales are."""
    table = results.table(
        f"{name}_scale_steps",
        f"{name} as an antialiased scene, preset {options.preset}, q = {options.q:g}",
        Column("steps of the scales, times a classic scene's", format="g"),
        *(Column(what, unit, form) for what, unit, form in _FIGURES),
    )
    for multiple in multiples:
        sf_scale = options.parameters.sf_scale * multiple / ANTIALIASED_SCALE_STEPS
        table.add(multiple, *judge.encoded(scene.rendered(True), options.with_parameters(sf_scale=sf_scale)))


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--scale-steps", nargs="+", type=float, metavar="X")
    parser.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT)
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    options = EncodeOptions.for_preset(args.preset)
    for folder in args.scenes:
        scene, cameras = read(folder)
        judge = Judge(device, scene, cameras)
        if args.scale_steps is None:
            against_classic(results, folder.name, scene, judge, options, args.qualities)
        else:
            by_scale_steps(results, folder.name, scene, judge, options, args.scale_steps)


if __name__ == "__main__":
    main()
