"""The linear least-squares problem of a re-fit and its solutions, for one scene and its views: :class:`ColourRefit`.

It puts together the vectors of coefficients (coefficients.py), the map from them to pictures (colour_map.py), perhaps
with workers that do some of the views (helpers.py), and the solver (solver.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Residency, residency_of
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.helpers import ColourHelpers, colour_parts, colour_shares
from potr_cl.stages.refitting.own_views import OwnViews
from potr_cl.stages.refitting.refit_options import AnyScene, ComingScene, RefitOptions, Refitted, arrived, colourless
from potr_cl.stages.refitting.sliced_arrays import Layout
from potr_cl.stages.refitting.solver import ColourSolver, Solved
from potr_cl.stages.refitting.view_kernels import RefitSweep
from potr_cl.views.reached import Reach, reached_splats
from potr_cl.views.shares import HelpFrom, ViewShares
from potr_cl.views.targets import Targets


class ColourRefit(Owner):
    """The map and the solver of one scene, for any number of solutions.

    Args:
        device: to compute on.
        scene: whose geometry, opacities and SH degree are used. If it is still to come, all is made ready meanwhile
            that its colours are enough for.
        cameras: the views that count, all the same whatever their size.
        background: of the rasterizer.
        memory: bytes of device memory that prepared views and targets may take, together with the vectors where these
            take much; None: views take two fifths of what is free, or a quarter where that is the host's
            memory.
        help_from: workers that do some of the views.
        slices: as of :class:`RefitOptions`.

    Attributes:
        coefficients, colour_map, solver: the vectors, the map, and who solves for them.

    Raises:
        UsageError: no camera.
        DeviceError: the scene or a view does not fit the device.
        What making a scene raises that is still to come.
    """

    def __init__(
        self,
        device: Device,
        scene: AnyScene,
        cameras: Sequence[Camera],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
        help_from: HelpFrom | None = None,
        slices: int | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("a re-fit needs at least one view")
        with ExitStack() as owned:
            own: Sequence[int] = range(len(cameras))
            others = None
            if help_from is not None:
                pool, source = help_from.pool, help_from.source
                share = source.dealt if isinstance(source, ViewShares) else colour_shares(pool, len(cameras))
                if share.others:
                    own = share.own
                    given = (pool, share, scene, background, help_from, cameras, memory)
                    others = owned.enter_context(colour_parts(*given))
            sweep = RefitSweep(device)
            layout = Layout(len(scene), stride_of(len(scene)), scene.sh.shape[1], sweep.lanes)
            # The vectors come first: prepared views can do with less memory, and only take longer then.
            size = layout.splats, layout.sh_count
            # What travels to other computers and back travels in one piece.
            far = others is not None and help_from is not None and not help_from.pool.in_process
            place = Residency(memory) if far else residency_of(device, *size, memory, slices, shared=others is not None)

            def looked_at(room: int | None) -> tuple[Rasterizer, Reach | None]:
                rasterizer = owned.enter_context(Rasterizer(device, colourless(arrived(scene))))
                return rasterizer, reached_splats(rasterizer, cameras, own, room)

            looked = None
            if place.slice is not None:  # the host has no room for vectors beside what rounds the geometry
                looked = looked_at(memory)
                scene = arrived(scene)
                if looked[1] is not None:
                    place = residency_of(device, *size, memory, slices, looked[1], others is not None)
            self.coefficients = owned.enter_context(Coefficients(device, layout, place.slice, place.resident))
            blocks = SplatBlocks(self.coefficients, place.blocks)
            self.solver = ColourSolver(self.coefficients, blocks)
            self._written: FloatArray | None = None  # colours that the start of the next solution has already
            if isinstance(scene, ComingScene):
                self.coefficients.write_sh(self.solver.x, scene.sh)
                self._written = scene.sh
            helpers = None
            if others is not None:
                helpers = owned.enter_context(ColourHelpers(self.coefficients, others, pool.in_process))
            rasterizer, reach = looked or looked_at(place.views)
            views = owned.enter_context(
                OwnViews(
                    sweep,
                    rasterizer,
                    self.coefficients,
                    cameras,
                    background,
                    place.views,
                    own,
                    reach,
                    shared=others is not None,
                )
            )
            self.colour_map = ColourMap(self.coefficients, views, helpers)
            if others is not None:
                owned.callback(others.begin_to_close)
            self._owned = owned.pop_all()

    def solve(
        self,
        sh: FloatArray,
        targets: Targets,
        options: RefitOptions,
        active: NDArray[np.bool_] | None = None,
        hold: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> Refitted:
        """Re-fit the active coefficients, after choosing among them if the options say so.

        Args:
            sh: (N, M, 3) R, G, B, the start.
            targets: the picture that each view should show.
            options: of the solver; their memory is of no account here.
            active: (N, M, 3) in Y, Co, Cg: the coefficients that may change; all by default.
            hold: whether the other coefficients keep their values; if not, they become 0.
            progress: called with the steps done and their greatest number.
        """
        self.start_from(sh, active, hold)

        def after_step(steps: int) -> None:
            if progress is not None:
                progress(steps, options.most_steps)

        solved = self.solver.solve(self.colour_map, targets, options.descent, options.selection, after_step)
        return Refitted(self.colours(), solved.errors, solved.steps)

    def start_from(self, sh: FloatArray, active: NDArray[np.bool_] | None = None, hold: bool = False) -> None:
        """Have the solver begin with these colours; as :meth:`solve` takes them."""
        coefficients, solver = self.coefficients, self.solver
        if self._written is not sh:
            coefficients.write_sh(solver.x, sh)
        self._written = None  # it changes
        coefficients.make_room()
        coefficients.activate(active)
        if active is not None and not hold:
            coefficients.keep_active(solver.x)

    def solve_constant(self, targets: Targets, options: RefitOptions, sh: FloatArray | None = None) -> Solved:
        """Re-fit the constant coefficients alone, after a solution for nearly the same colours.

        Args:
            targets, options: as :meth:`solve` takes them; none are given up.
            sh: (N, M, 3) R, G, B, the start; None: the solution before, perhaps rounded. AC coefficients stay.
        """
        coefficients, solver = self.coefficients, self.solver
        if sh is not None:
            coefficients.write_sh(solver.x, sh)
        coefficients.activate_constant()
        return solver.solve(self.colour_map, targets, options.descent, constant=True)

    def colours(self) -> FloatArray:
        """(N, M, 3) float32 R, G, B, the solution."""
        return self.coefficients.read_sh(self.solver.x)

    def worth_of_constants(self) -> FloatArray:
        """(N,) float32: :meth:`worth` of the constant coefficients."""
        return self.solver.blocks.constants() / np.float32(self.colour_map.total_weight)

    def worth(self) -> FloatArray:
        """(N, M) float32: by how much the mean squared error grows for an error of 1 in a coefficient of one channel.

        As the last solution has found it at its start; errors of different coefficients are taken as independent.
        """
        return self.solver.blocks.diagonals() / np.float32(self.colour_map.total_weight)

    def blocks(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32: the same for errors of a splat's coefficients together, upper triangles."""
        return self.solver.blocks.packed() / np.float32(self.colour_map.total_weight)

    def active(self) -> NDArray[np.bool_]:
        """(N, M, 3) in Y, Co, Cg: the coefficients that the last solution left active."""
        return self.coefficients.is_active()
