"""What is lost if an antialiased scene is encoded as if it were a classic one.

    python -m tools.study.antialiasing SCENE … [--qualities Q …] [--preset NAME] [--json FILE]

Each scene is taken as an antialiased one, whatever it was trained as, and encoded twice: as what it is, and as a
classic scene, whose pictures the encoder then compares, prunes by and re-fits to. Both files are judged as they will be
looked at: PSNR is the mean over the test views, rendered with antialiasing, against the uncompressed scene's. What a
scene loses by being shown the wrong way, before anything is compressed, is said in the title.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.codec.decoder import PotrFile
from potr_cl.model.camera import test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import DEFAULT, PRESETS
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scene_parser

QUALITIES = (0.3, 0.5, 0.7)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--preset", choices=tuple(PRESETS), default=DEFAULT)
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    options = EncodeOptions.for_preset(args.preset)
    for folder in args.scenes:
        scene, cameras = read(folder)
        views, judges = train_views(cameras), test_views(cameras)
        marked = scene.rendered(True)
        wanted = pictures(device, marked, judges)

        def judged(candidate, wanted=wanted, judges=judges) -> float:  # type: ignore[no-untyped-def]
            shown = pictures(device, candidate.rendered(True), judges)
            return float(np.mean([psnr(a, b) for a, b in zip(wanted, shown, strict=True)]))

        shown_wrongly = pictures(device, scene.rendered(False), judges)
        wrong = float(np.mean([psnr(a, b) for a, b in zip(wanted, shown_wrongly, strict=True)]))
        table = results.table(
            folder.name,
            f"{folder.name} as an antialiased scene, preset {args.preset}; rendered as a classic one, uncompressed, it "
            f"is {wrong:.1f} dB from itself",
            Column("q", format="g"),
            *(
                Column(f"as {name}: {what}", unit, form)
                for name in ("antialiased", "classic")
                for what, unit, form in (("splats", "", ","), ("bytes", "", ","), ("PSNR", "dB", ".2f"))
            ),
        )
        for q in args.qualities:
            figures: list[float] = []
            for kind in (True, False):
                encoded = encode(marked.rendered(kind), views, dataclasses.replace(options, q=q), device=device)
                decoded = PotrFile.from_bytes(b"".join(encoded.pieces)).scene()
                figures += [len(decoded), encoded.nbytes, judged(decoded)]
            table.add(q, *figures)


if __name__ == "__main__":
    main()
