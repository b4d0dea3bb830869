"""The command view: scenes in the browser."""

from __future__ import annotations

import argparse
import os
import sys

from potr_cl.api.viewing import HOST, PORT, view
from potr_cl.cli.guard import ReadCameras, ReadFile, ReadPhotographs
from potr_cl.cli.options import CAMERAS_HELP, Commands, add_rendering_options
from potr_cl.cli.parser import whole_number
from potr_cl.cli.scenes import ANTIALIASED, add_antialiased_option, add_trust_option
from potr_cl.cli.terminal import note, say_done


def _view(args: argparse.Namespace) -> None:
    with view(
        args.a, args.b, args.cameras,
        truth=args.truth, host=args.host, port=args.port, browser=args.browser and _has_screen(), device=args.device,
        rules=args.rules, background=args.background, trust=args.trust, antialiased=ANTIALIASED[args.antialiased],
    ) as viewer:  # fmt: skip
        say_done(f"viewer: {viewer.url} (Ctrl-C to stop)")
        if args.host != HOST:
            note("warning: whoever reaches this machine can open the page: it has no password", "warning")
        viewer.wait()


def _has_screen() -> bool:
    """Whether a browser that is opened would be seen: over SSH it would fill the terminal."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def add_view(commands: Commands) -> None:
    p = commands.add_parser(
        "view",
        help="a page in the browser that shows a scene, or two beside each other",
        description="Show a scene in the browser, or two beside each other: divider, difference, heat map, PSNR and "
        'SSIM of what is seen, the cameras, and the views sorted by loss. Needs pip install "potr_cl[view]".',
    )
    p.add_argument(
        "a",
        type=ReadFile,
        metavar="A",
        help="the scene, or the uncompressed one of two; or a ladder's folder or ladder.json (encode --ladder)",
    )
    p.add_argument("b", type=ReadFile, nargs="?", metavar="B", help="the scene or ladder to compare with A")
    p.add_argument("--cameras", type=ReadCameras, metavar="PATH", help=f"{CAMERAS_HELP}; without it, views are placed")
    p.add_argument(
        "--truth",
        type=ReadPhotographs,
        metavar="DIR",
        help="photographs, named after the views, to show over the pictures",
    )
    p.add_argument("--port", type=whole_number, default=PORT, metavar="PORT", help=f"default {PORT}; 0: any free one")
    p.add_argument(
        "--host",
        default=HOST,
        metavar="ADDRESS",
        help="address to listen on; default: this machine only; 0.0.0.0 admits everybody who can reach the machine",
    )
    p.add_argument("--no-browser", dest="browser", action="store_false", help="print the address, open no browser")
    add_trust_option(p)
    add_antialiased_option(p)
    add_rendering_options(p)
    p.set_defaults(run=_view)
