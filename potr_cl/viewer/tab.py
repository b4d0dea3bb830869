"""One tab of a browser as the server knows it (:class:`TabHandle`): viser's client, its panel, and its visitor."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.viewer.comparison import FACTORS, MODES
from potr_cl.viewer.flight import fade, fly, land, put
from potr_cl.viewer.frusta import add_frusta
from potr_cl.viewer.painter import decibels
from potr_cl.viewer.pose import Gaze, gaze_on, rotation_of
from potr_cl.viewer.session import Exhibit, Which
from potr_cl.viewer.visitor import Shown, Visitor

if TYPE_CHECKING:
    from potr_cl.viewer.server import Viewer

#: Qualities of the pictures that are sent while the camera moves, and when it stands.
_QUICK, _GOOD = 75, 95
#: Frusta nearer than so many times their own size are not drawn.
_NEAR = 4.0


class TabHandle:
    """Fills a tab's panel, takes what its user does, and sends its pictures.

    Args:
        client: viser's.
        house: the server.
        cameras: of the scene, if there are any.
    """

    def __init__(self, client: Any, house: Viewer, cameras: list[Camera]) -> None:
        self.key = secrets.token_urlsafe(16)
        self._client = client
        self._house = house
        self._cameras = cameras
        self._send: Callable[[dict[str, Any]], None] = lambda _message: None
        self._flights = 0
        self._lock = threading.Lock()
        self._here = True
        self._asked = 0
        self._goal: int | None = None
        #: What the browser has said of its camera last, and when.
        self._told: tuple[Gaze, float] | None = None
        self._said = ""
        self.visitor = Visitor(client.client_id, self._show, self._tell)
        self._add_panel()
        self._frusta = add_frusta(client.scene, cameras, self.fly)
        self._centres = camera_centres(cameras)
        self.restate()
        self._look(client.camera)  # what the browser has said before anybody listened
        client.camera.on_update(self._moved)
        if house.losses.views:  # viser has only the first view's place and direction, not what its picture holds
            self._goal = 0
            camera = client.camera
            gaze = gaze_on(house.losses.views[0], camera.image_width / max(camera.image_height, 1))
            put(camera, gaze.position, gaze.rotation, gaze.fov)
            threading.Thread(target=self._land, args=(gaze, 0), name="potr_cl landing", daemon=True).start()

    def _add_panel(self) -> None:
        gui = self._client.gui
        gui.add_html(_box("error"), order=-1)
        self._mode = gui.add_dropdown(
            "show",
            MODES,
            initial_value=self.visitor.mode,
            order=3,
            hint="keys 1 to 6; hold F to swap A and B",
        )
        self._mode.on_update(lambda _: self.choose_mode(self._mode.value))
        self._factor = gui.add_dropdown("amplify", FACTORS, initial_value="auto", order=4)
        self._factor.on_update(lambda _: self._amplify())
        gui.add_html(_box("drawn"), order=2.5)
        gui.add_html(_box("figures"), order=5)
        self._photograph = gui.add_slider(
            "photograph", 0.0, 1.0, 0.01, 0.0, order=6, hint="how much of the photograph shows over the picture"
        )
        self._photograph.on_update(lambda event: self._fade(event))
        # Off at first: they would hide what is to be compared.
        self._shows_frusta = gui.add_checkbox(
            "cameras", False, order=7, visible=bool(self._cameras), hint="key C; a click on one flies there"
        )
        self._shows_frusta.on_update(lambda _: self._arrange())
        gui.add_html(_box("views"), order=8)

    def show_key(self) -> None:
        """Give the page the key by which it finds this tab; it asks for it at once, and once only.

        The key is in the page alone: only a page that viser serves can find its tab.
        """
        self._client.gui.add_html(f'<div data-potr-key="{escape(self.key)}" hidden></div>', order=-2)

    # ------------------------------------------------------------------------------- what the user does

    def divide(self, at: float) -> None:
        """The divider was drawn to a part of the width."""
        self.visitor.divider = at
        self._house.painter.wake(self.visitor)

    def swap(self, swapped: bool) -> None:
        """The flicker key was pressed, or let go."""
        self.visitor.swapped = swapped
        self._house.painter.wake(self.visitor, look=self.visitor.mode in ("A", "B"))
        self.restate(everything=False)

    def toggle_cameras(self) -> None:
        self._shows_frusta.value = not self._shows_frusta.value
        self._arrange()

    def choose_mode(self, mode: str) -> None:
        chosen = next((each for each in MODES if each == mode), None)
        if chosen is None or chosen == self.visitor.mode:
            return
        self.visitor.mode = chosen
        self.visitor.is_still = False
        if self._mode.value != chosen:
            self._mode.value = chosen
        self._house.painter.wake(self.visitor, look=True)
        self.restate(everything=False)

    def draw(self, draws: bool) -> None:
        """The page draws the scenes by itself, or no longer."""
        self.visitor.draws, self.visitor.is_still = draws, False
        self._house.painter.wake(self.visitor, look=True)

    def file(self, number: int) -> bytes:
        """As :meth:`potr_cl.viewer.server.Viewer.file`."""
        return self._house.file(number)

    def climb(self, rung: int) -> None:
        self._house.climb(rung)

    def acknowledge(self, asked: int) -> None:
        """How often a rung has been asked for by now."""
        self._asked = asked
        self.restate()

    def dropped(self, which: Which, exhibit: Exhibit) -> None:
        self._house.put(which, exhibit)

    def connected(self, send: Callable[[dict[str, Any]], None]) -> None:
        """The channel is there; any thread may send by it."""
        self._send = send
        self.restate()
        self._house.painter.wake(self.visitor)

    def fly(self, view: int) -> None:
        if not 0 <= view < len(self._house.losses.views):
            return
        with self._lock:
            self._flights += 1
            number = self._flights
            self._goal = None
        threading.Thread(target=self._fly, args=(view, number), name="potr_cl flight", daemon=True).start()

    def leave(self) -> None:
        """The tab is closed."""
        self._here = False

    # ------------------------------------------------------------------------------- what the user sees

    def restate(self, everything: bool = True) -> None:
        """Tell the page what it shows beside the picture: everything, or only what is this tab's own."""
        asked = self._asked  # read before the rung, so that the page never takes an older rung for the answer
        pair, swapped = self._house.is_pair(), self.visitor.swapped
        names = ("B", "A") if swapped else ("A", "B")
        labels = {
            "divider": names,
            "side by side": names,
            "A": (names[0], ""),
            "B": (names[1], ""),
        }.get(self.visitor.mode, ("A – B", ""))
        self._send(
            {
                "state": {
                    **({**self._house.state(), "asked": asked} if everything else {}),
                    "mode": self.visitor.mode,
                    "divider": self.visitor.divider,
                    "labels": labels if pair else None,
                    "at": self.visitor.view,
                }
            }
        )
        self._arrange()

    def _arrange(self) -> None:
        """Show in the panel what is of use now."""
        pair, view = self._house.is_pair(), self.visitor.view
        self._mode.visible = pair
        self._factor.visible = pair and self.visitor.mode in ("difference", "heat map")
        self._photograph.visible = view is not None and self._house.losses.has_photograph(view)
        # Beside each other both pictures are half as wide, and what viser draws over them would fit neither.
        seen = self._shows_frusta.value and not (pair and self.visitor.mode == "side by side")
        gaze = self.visitor.gaze
        far = np.full(len(self._centres), np.inf)
        if gaze is not None:
            far = np.linalg.norm(self._centres - gaze.position, axis=1)
        for number, frustum in self._frusta.items():
            # One that the camera stands in or beside is only a line across the picture.
            visible = bool(seen and number != view and far[number] >= _NEAR * frustum.scale)
            if frustum.visible != visible:
                frustum.visible = visible

    def _show(self, shown: Shown) -> None:
        if not self._here:
            return
        self._client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=_GOOD if shown.still else _QUICK
        )
        self._client.flush()  # else viser gathers messages for a sixtieth of a second
        if shown.still:
            self._arrange()
        look, height, width = shown.look, shown.look.camera.height, shown.look.camera.width
        if shown.picture is not None:
            height, width = shown.picture.shape[:2]
        values = []
        if look.psnr is not None and look.ssim is not None:
            values = [["PSNR", decibels(look.psnr)], ["SSIM", f"{look.ssim:.4f}"]]
        if values or shown.still or not self._house.is_pair():
            mode = self.visitor.mode
            heat = f"difference {1 / shown.factor:g} of 1" if mode == "heat map" else None
            note = f"{width} × {height}" + (f", difference × {shown.factor}" if mode == "difference" else "")
            self._last = {"values": values, "note": note}
            self._send({"state": {"figures": {**self._last, "old": False}, "heat": heat}})
        else:
            self._send({"state": {"figures": {**getattr(self, "_last", {"values": [], "note": ""}), "old": True}}})

    def _tell(self, said: str) -> None:
        if said != self._said:
            self._said = said
            self._send({"state": {"error": said}})

    # ------------------------------------------------------------------------------- the camera

    async def _moved(self, camera: Any) -> None:
        """viser has heard from the browser's camera. In viser's own thread, so that the last word stays the last."""
        self._look(camera)

    def _look(self, camera: Any) -> None:
        gaze = Gaze(np.array(camera.position, np.float64), rotation_of(np.array(camera.wxyz)), float(camera.fov))
        size = int(camera.image_width), int(camera.image_height)
        if min(size) < 1 or not all(np.isfinite(part).all() for part in (gaze.position, gaze.rotation, gaze.fov)):
            return
        visitor, now = self.visitor, time.monotonic()
        # By what is shown, and not by what was told last: else small steps would lead away unseen.
        moves = visitor.gaze is None or size != (visitor.width, visitor.height) or not gaze.is_near(visitor.gaze)
        if moves:
            visitor.width, visitor.height = size
            visitor.gaze, visitor.moved, visitor.is_still = gaze, now, False
        self._told = gaze, now
        self._notice()
        if moves:
            self._house.painter.wake(visitor, look=True)

    def _notice(self) -> None:
        """See whether the camera is at the view that it was to fly to.

        The goal stays one after it is reached: in the last step of a flight viser for a moment takes its own word for
        the browser's, which then tells of the step before.
        """
        with self._lock:
            told, goal, visitor = self._told, self._goal, self.visitor
            view = goal if told is not None and goal is not None and self._is_at(goal, told[0]) else None
            if view == visitor.view:
                return
            visitor.view = view
            if view is None:
                visitor.fade = 0.0
        self.restate(everything=False)

    def _is_at(self, view: int, gaze: Gaze) -> bool:
        return gaze.is_near(gaze_on(self._house.losses.views[view], self.visitor.width / self.visitor.height))

    def _fly(self, view: int, number: int) -> None:
        visitor = self.visitor
        if visitor.gaze is None:
            return
        with self._lock:
            if not self._goes_on(number):
                return
            self._goal = view
        self._notice()  # it may be there already, and the browser has nothing to tell
        goal = gaze_on(self._house.losses.views[view], visitor.width / visitor.height)
        fly(self._client.camera, goal, lambda: self._goes_on(number))
        if not self._land(goal, number) or visitor.view != view:
            return
        if self._house.losses.has_photograph(view):
            fade(
                lambda part: self._fade_to(part, on_slider=True),
                lambda: self._goes_on(number) and visitor.view == view,
            )

    def _land(self, goal: Gaze, number: int) -> bool:
        return land(self._client.camera, goal, lambda: self._told, lambda: self._goes_on(number))

    def _goes_on(self, number: int) -> bool:
        return self._here and self._flights == number

    def _fade(self, event: Any) -> None:
        if event.client is not None:  # the user, and not the program, has moved the slider
            with self._lock:
                self._flights += 1
            self._fade_to(min(max(float(self._photograph.value), 0.0), 1.0))

    def _fade_to(self, part: float, on_slider: bool = False) -> None:
        self.visitor.fade = part
        if on_slider:
            self._photograph.value = round(part, 2)
        self._house.painter.wake(self.visitor)

    def _amplify(self) -> None:
        value = self._factor.value
        self.visitor.factor = int(value) if value in FACTORS and value != "auto" else None
        self._house.painter.wake(self.visitor)


def _box(name: str) -> str:
    """A place in the panel that page.js fills."""
    return f'<div class="potr-box" data-potr="{name}"></div>'
