"""The viewer (:class:`Viewer`): a page on this machine that shows one scene, or two beside each other."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import load_scene
from potr_cl.formats.images import Colour, to_8_bits
from potr_cl.formats.ladder import Ladder
from potr_cl.host.libraries import install_command
from potr_cl.model.camera import Camera, focus
from potr_cl.opencl.device import Device
from potr_cl.plain_text import LONGEST_VALUE, plain
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rules import RasterRules
from potr_cl.report.labels import U8
from potr_cl.report.style import ACCENT, rgb
from potr_cl.viewer import page
from potr_cl.viewer.access import Door
from potr_cl.viewer.channel import Channel
from potr_cl.viewer.comparison import compared
from potr_cl.viewer.losses import Losses
from potr_cl.viewer.notebook import notebook_bundle
from potr_cl.viewer.painter import Painter, decibels
from potr_cl.viewer.pose import camera_of, gaze_on
from potr_cl.viewer.session import Exhibit, Session, Which
from potr_cl.viewer.tab import TabHandle

if TYPE_CHECKING:
    from typing_extensions import Self

#: Only this machine.
LOCALHOST = "127.0.0.1"
#: Bytes of decoded rungs that are kept.
_KEPT = 1 << 30
#: Splats that a page draws at most, of all its scenes: some 500 MB of its memory.
MOST_DRAWN = 3_000_000
#: Seconds between two lists of views while losses are being found.
_LIST_EVERY = 1.0


class Viewer:
    """Shows scenes in a browser until it is closed.

    Args:
        a: the reference, or the only scene; None: nothing yet.
        b: to compare with it.
        views: to fly to; the page begins at the first one.
        cameras: of them, those to draw.
        photographs: of the views.
        ladder: whose rungs may be chosen as B.
        open_device: opens the device, in the thread that uses it.
        rules, background: of the rasterizer.
        host: the address to listen on; by default only this machine can connect.
        port: 0: any that is free.
        antialiased: how dropped files and rungs are rendered, as of :func:`potr_cl.load_scene`.

    Attributes:
        url: where the page is.

    Raises:
        UsageError: the address cannot be listened on.
    """

    def __init__(
        self,
        a: Exhibit | None,
        b: Exhibit | None,
        *,
        views: Sequence[Camera],
        cameras: Sequence[Camera],
        photographs: GroundTruth | None,
        ladder: Ladder | None,
        open_device: Callable[[], Device],
        rules: RasterRules,
        background: Colour,
        host: str = LOCALHOST,
        port: int = 8080,
        antialiased: bool | None = None,
    ) -> None:
        self.session = Session(open_device, rules, background)
        self.losses = Losses(views, photographs)
        self.painter = Painter(self.session, self.losses, self._list_views)
        self._cameras = list(cameras)
        self._background = "rgb({})".format(",".join(f"{round(255 * part)}" for part in background))
        self._ladder = ladder
        self._antialiased = antialiased
        self._rung = _middle(ladder) if ladder is not None else 0
        self._kept: OrderedDict[int, Exhibit] = OrderedDict()
        self._tabs: dict[int, TabHandle] = {}
        self._lock = threading.Lock()
        self._listed = 0.0
        self._views_state: dict[str, Any] = {}
        self._closed = threading.Event()
        self._readers = ThreadPoolExecutor(1, thread_name_prefix="potr_cl reader")
        for which, exhibit in (("A", a), ("B", b)):
            if exhibit is not None:
                self.session.show("A" if which == "A" else "B", exhibit)
        self.losses.begin(self.session.is_pair)
        self._server = self._started(host, port)
        self.url = f"http://{_shown(host)}:{self._server.get_port()}"
        self._furnish(views)
        self.painter.start()
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)
        if ladder is not None and b is None:
            self.climb(self._rung)

    def _started(self, host: str, port: int) -> Any:
        import viser

        check_address(host, port)
        channel = Channel(self._tab_of, self._readers, self._antialiased)
        assets = page.assets()
        self._has_script = page.DRAWING in assets
        door = Door(host, assets, page.head(), {page.CHANNEL: channel.serve})
        with door.guarding(), _silent():
            server = viser.ViserServer(host=host, port=port, label="potr_cl", verbose=False)
        # It warns of whatever a tab that has just been closed is told.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        if port not in (0, server.get_port()):
            server.stop()
            raise UsageError(_taken(port))
        return server

    def _furnish(self, views: Sequence[Camera]) -> None:
        server = self._server
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=rgb(ACCENT), control_width="medium"
        )
        server.gui.add_html('<div class="potr-box" data-potr="scenes"></div>', order=0)
        if self._ladder is not None:
            rungs = self._ladder.rungs
            low, high = rungs[0].q, rungs[-1].q
            self._slider = server.gui.add_slider(
                "quality",
                low,
                high if high > low else low + 0.01,
                0.01,
                rungs[self._rung].q,
                marks=tuple((rung.q, f"{rung.q:g}") for rung in rungs) if len(rungs) <= 7 else None,
                order=1,
                hint="q, from 0, smallest, to 1, best",
            )
            self._slider.on_update(self._slid)
            server.gui.add_html('<div class="potr-box" data-potr="curve"></div>', order=2)
        if views:
            first = gaze_on(views[0], 16 / 9)
            distance = max(float((focus(views) - first.position) @ first.rotation[:, 2]), 1e-3)
            server.initial_camera.position = tuple(first.position)
            server.initial_camera.look_at = tuple(first.position + distance * first.rotation[:, 2])
            server.initial_camera.up = tuple(-first.rotation[:, 1])
            server.initial_camera.fov = first.fov
            up = -sum(camera.rotation[1] for camera in views)
            server.scene.set_up_direction(tuple(up) if abs(up).max() > 1e-6 else tuple(-first.rotation[:, 1]))

    # ------------------------------------------------------------------------------- tabs

    def _enter(self, client: Any) -> None:
        tab = TabHandle(client, self, self._cameras)
        with self._lock:
            self._tabs[client.client_id] = tab
        tab.show_key()  # now it can be found
        self.painter.enter(tab.visitor)
        if client.client_id not in self._server.get_clients():  # it left while its panel was being made
            self._leave(client)

    def _leave(self, client: Any) -> None:
        with self._lock:
            tab = self._tabs.pop(client.client_id, None)
        self.painter.leave(client.client_id)
        if tab is not None:
            tab.leave()

    def _tab_of(self, key: str) -> TabHandle | None:
        with self._lock:
            return next((tab for tab in self._tabs.values() if tab.key == key), None)

    def _restate(self) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.restate()

    # ------------------------------------------------------------------------------- what is shown

    def is_pair(self) -> bool:
        """Whether there are two scenes to compare."""
        return self.session.is_pair

    def put(self, which: Which, exhibit: Exhibit) -> None:
        """Show a scene to all tabs, as A or as B."""

        def job() -> None:
            self.session.show(which, exhibit)
            self.painter.all_anew()
            self._list_views(at_once=True)

        self.painter.do(job)

    def file(self, number: int) -> bytes:
        """A scene for a page to draw, a .potr file.

        Raises:
            PotrError, OSError, MemoryError: it is shown no longer, or there can be none.
        """
        for which in ("A", "B"):
            exhibit = self.session.exhibit("A" if which == "A" else "B")
            if exhibit is not None and exhibit.number == number:
                return exhibit.potr
        raise UsageError("this scene is shown no longer")

    def _slid(self, event: Any) -> None:
        if self._ladder is not None and event.client is not None:  # the user, not the program
            rungs, wanted = self._ladder.rungs, float(self._slider.value)
            self.climb(min(range(len(rungs)), key=lambda k: abs(rungs[k].q - wanted)))

    def climb(self, rung: int) -> None:
        """Show a rung of the ladder as B; of several in a row the last one is shown."""
        if self._ladder is None or not 0 <= rung < len(self._ladder.rungs):
            return
        if rung != self._rung:
            self._rung = rung
            self._restate()
        self._readers.submit(self._climb, rung)

    def _climb(self, rung: int) -> None:
        ladder = self._ladder
        if ladder is None or rung != self._rung or self._closed.is_set():
            return
        try:
            if rung not in self._kept:
                path = ladder.file(ladder.rungs[rung])
                scene = load_scene(path, antialiased=self._antialiased)
                name = plain(path.name, LONGEST_VALUE)
                self._kept[rung] = Exhibit(scene, name, path.stat().st_size, path)
            self._kept.move_to_end(rung)
            while len(self._kept) > 1 and sum(each.scene.nbytes for each in self._kept.values()) > _KEPT:
                self._kept.popitem(last=False)
            exhibit = self.session.exhibit("B")
            if exhibit is not self._kept[rung]:
                self.put("B", self._kept[rung])
            self._slider.value = ladder.rungs[rung].q  # where it was drawn to there may be no file
        except (PotrError, OSError, MemoryError) as error:
            said = plain(error if isinstance(error, PotrError) else f"cannot read this quality's file: {error}")
            for visitor in self.painter.visitors:
                visitor.tell(said)

    def state(self) -> dict[str, Any]:
        """What all tabs are told of the scenes, the ladder and the views."""
        there = {which: self.session.exhibit(which) for which in ("A", "B")}
        a, b = there["A"], there["B"]
        note = ""
        if a is not None and b is not None and b.nbytes > 0:
            ratio = a.nbytes / b.nbytes
            if abs(ratio - 1) < 0.005:
                note = "A and B are equally large"
            else:
                note = f"B is {ratio:.1f} times smaller" if ratio > 1 else f"B is {1 / ratio:.1f} times larger"
        shown = [exhibit for exhibit in there.values() if exhibit is not None]
        drawable = (
            self._has_script
            and sum(len(exhibit.scene) for exhibit in shown) <= MOST_DRAWN
            and not any(exhibit.scene.antialiased for exhibit in shown)
        )
        ladder = None
        if self._ladder is not None:
            ladder = {
                "at": self._rung,
                "rungs": [
                    {"n": n, "q": f"{rung.q:g}", "bytes": rung.bytes, "size": _size(rung.bytes), "psnr": rung.psnr}
                    for n, rung in enumerate(self._ladder.rungs)
                ],
            }
        return {
            "pair": self.session.is_pair,
            "scenes": [
                {
                    "which": which if self.session.is_pair else "",
                    "name": plain(exhibit.name, LONGEST_VALUE),
                    "size": f"{_size(exhibit.nbytes)}, {len(exhibit.scene):,} splats",
                }
                for which, exhibit in there.items()
                if exhibit is not None
            ],
            "note": note,
            "drawable": {which: exhibit.number for which, exhibit in there.items() if exhibit} if drawable else None,
            "background": self._background,
            "ladder": ladder,
            **(self._views_state or self._views()),
        }

    def _list_views(self, at_once: bool = False) -> None:
        """Tell all tabs what is known of the views; not after every one."""
        now = time.monotonic()
        if at_once or self.losses.is_complete or now - self._listed >= _LIST_EVERY:
            self._listed = now
            self._views_state = self._views()
            self._restate()

    def _views(self) -> dict[str, Any]:
        losses = self.losses
        rows = []
        for number in losses.order():
            camera, loss = losses.views[number], losses.of(number)
            text = ""
            if loss is not None and loss.photograph_a is not None and loss.photograph_b is not None:
                text = f"{loss.photograph_b - loss.photograph_a:+.2f} dB"
            elif loss is not None and math.isfinite(loss.order):
                text = decibels(loss.order)
            elif loss is not None and loss.psnr is not None:
                text = decibels(loss.psnr)
            rows.append({"n": number, "name": plain(camera.name), "test": camera.split == "test", "text": text})
        found = [loss for loss in map(losses.of, range(len(rows))) if loss is not None]
        note, mean = f"{len(rows)} views", losses.mean()
        if found:
            by_photograph = any(loss.photograph_a is not None and loss.photograph_b is not None for loss in found)
            note = "views, worst first: " + ("B against A on the photograph" if by_photograph else "PSNR")
            if mean is not None:
                note += f"; mean PSNR {decibels(mean)}"
            if not losses.is_complete:
                note += f"; {len(found)} judged so far"
        if losses.trouble:
            note += f"; {plain(losses.trouble)}"
        return {"views": rows, "viewsNote": note}

    # ------------------------------------------------------------------------------- the end

    def wait(self) -> None:
        """Serve until :meth:`close` is called, or the program is interrupted."""
        while not self._closed.wait(0.5):
            pass

    def close(self) -> None:
        """End the page, and give the device's memory back. Closing twice does no harm."""
        if self._closed.is_set():
            return
        self._closed.set()
        self.painter.stop()
        self._readers.shutdown(wait=False, cancel_futures=True)
        with _silent():
            self._server.stop()

    def still(self, width: int = 800, height: int = 500) -> U8 | None:
        """A picture of where the page begins, (H, W, 3) uint8: A to the left of the middle, B to the right.

        None where there is nothing to see.

        Raises:
            DeviceError: it does not fit the device, or the device failed.
        """
        if not self.losses.views:
            return None
        camera = camera_of(gaze_on(self.losses.views[0], width / height), width, height)
        look = self.painter.ask(lambda: self.session.look(camera))
        if look is None:
            return None
        only = look.a if look.a is not None else look.b
        if look.a is not None and look.b is not None:
            return compared("divider", look.a, look.b)[0]
        return None if only is None else to_8_bits(only)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        there = self.session.exhibit("A"), self.session.exhibit("B")
        names = [plain(each.name, LONGEST_VALUE) for each in there if each is not None]
        return f"Viewer({' and '.join(names) or 'no scene yet'}, {'closed' if self._closed.is_set() else self.url})"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        """For notebooks: the page, and a still where no browser shows it."""
        picture = None
        with contextlib.suppress(PotrError):  # a notebook shows the words then
            picture = self.still()
        return notebook_bundle(repr(self), None if self._closed.is_set() else self.url, picture)


def _middle(ladder: Ladder) -> int:
    """The rung that is shown first: that of the usual quality, or what is nearest."""
    return min(range(len(ladder.rungs)), key=lambda k: abs(ladder.rungs[k].q - 0.5))


def _size(nbytes: int) -> str:
    return f"{nbytes / 1e6:.2f} MB" if nbytes >= 1e6 else f"{nbytes / 1e3:.2f} kB"


def _shown(host: str) -> str:
    if host in ("0.0.0.0", "::", ""):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _taken(port: int) -> str:
    return f"--port {port} is taken by another program: give another one, or 0 for any that is free"


def check_viser() -> None:
    """Refuse to begin without the extra ``view``.

    Raises:
        UsageError: viser is missing.
    """
    try:
        import viser  # noqa: F401
    except ImportError:
        raise UsageError(f"the viewer needs viser: {install_command('view')}") from None


def check_address(host: str, port: int) -> None:
    """Refuse an address that cannot be listened on: viser would take the next free port instead, in silence.

    Raises:
        UsageError: there is no such address here, or the port is taken or out of range.
    """
    if not 0 <= port <= 65535:
        raise UsageError(f"--port is {port}, it must lie between 0 and 65535")
    try:
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in found[:1]:
            with socket.socket(family, kind, protocol) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind(address)
    except PermissionError:
        raise UsageError(f"--port {port} is not yours to open: give one from 1024 on") from None
    except OSError as error:
        import errno

        if error.errno == errno.EADDRINUSE:
            raise UsageError(_taken(port)) from None
        raise UsageError(f"--host '{plain(host, LONGEST_VALUE)}' is no address of this machine") from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """viser tells of itself on standard output, which is the caller's."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
