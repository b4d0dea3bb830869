"""Joint re-fit of the colours: :func:`refit_colours` wins back what pruning and compaction have lost.

With fixed geometry and opacities a picture is linear in the SH coefficients, except where a colour is cut at 0
(colour_map.py). So one linear least-squares problem gives the coefficients of all splats together, such that the
pictures of all views come near to given ones (targets.py). As in the compaction, a ridge holds the AC coefficients down
(solver.py).

This is not in the paper, which solves for each splat alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import nonzero_levels
from potr_cl.errors import UsageError
from potr_cl.host.threads import in_background
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.view_shares import ViewShares
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.launcher import launcher_for
from potr_cl.stages.refitting.pictures_ahead import PicturesAhead
from potr_cl.stages.refitting.placement import blocks_of, left_for_views, placed, rounding_of, vectors_of
from potr_cl.stages.refitting.rounding import ROUNDS
from potr_cl.stages.refitting.shared_map import SharedViews, colour_parts, colour_shares
from potr_cl.stages.refitting.solver import ColourSolver, Descent, Selection, Solved
from potr_cl.stages.refitting.targets import Targets
from potr_cl.stages.refitting.vector_space import Layout, Ridge, Vector
from potr_cl.workers.dealing import Shares
from potr_cl.workers.pool import Pool

#: Steps in which the constant coefficients are solved for once more, after the others have been rounded.
_CONSTANT_STEPS = 3
#: What a coefficient that becomes 0 as it is rounded is worth, as a part of what one is worth that is given up before.
#: What the others of the splat are counted on to make up for is more than they can.
_WORTH = 0.4


@dataclass(frozen=True)
class RefitOptions:
    """How to re-fit.

    Attributes:
        steps: the most conjugate-gradient steps.
        drop: AC coefficients that cost less mean squared error than this are set to 0 for good, after
            ``selection_steps`` steps. 0: none is.
        selection_steps, selection_lam: steps and lambda before that choice.
        gain: stop when a step takes less than this part off the squared error.
        lam: lambda on the AC coefficients of Y, in pixels of an image of :data:`REFERENCE_PIXELS`.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: the same for every coefficient's distance to its start, so that what no view shows stays as it was.
        memory: bytes of device memory that prepared views and targets may take; None: a quarter of what is free.
        slices: splats of a slice, with the vectors on the host (:mod:`potr_cl.stages.refitting.placement`); None: only
            where they do not fit.

    Raises:
        UsageError: a value is out of range.
    """

    steps: int = 8
    drop: float = 0.0
    selection_steps: int = 2
    selection_lam: float = 0.0
    gain: float = 0.01
    lam: float = 0.0
    chroma_factor: float = 3.0
    prior: float = 0.1
    memory: int | None = None
    slices: int | None = None

    def __post_init__(self) -> None:
        if self.slices is not None and self.slices < 1:
            raise UsageError(f"slices of {self.slices} splats: at least 1 is needed")
        if self.steps < 0:
            raise UsageError(f"{self.steps} re-fit steps: it must be 0 or more")
        if not 0 <= self.gain < 1:
            raise UsageError(f"the re-fit's least gain a step is {self.gain:g}, it must be 0 or more and below 1")
        if self.selection_steps < 0:
            raise UsageError(f"{self.selection_steps} re-fit steps: it must be 0 or more")
        for name in ("lam", "chroma_factor", "prior", "drop", "selection_lam"):
            if not 0 <= getattr(self, name) <= 1e12:
                raise UsageError(f"the re-fit's {name} is {getattr(self, name):g}, it must lie between 0 and 1e12")


@dataclass(frozen=True)
class Refitted:
    """What a re-fit did.

    Attributes:
        sh: (N, M, 3) float32 coefficients, R, G, B.
        errors: mean squared error over views, pixels and channels before, and after.
        steps: conjugate-gradient steps that were taken.
    """

    sh: FloatArray
    errors: tuple[float, float]
    steps: int


def refit_colours(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    targets: Targets,
    options: RefitOptions | None = None,
    active: NDArray[np.bool_] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Callable[[int, int], None] | None = None,
    fix_ac: Callable[[FloatArray, ColourRefit], FloatArray] | None = None,
    help_from: HelpFrom | None = None,
    colour_grid: Callable[[FloatArray], ColourGrid] | None = None,
) -> Refitted:
    """Re-fit a scene's colours to pictures of all views together.

    Args:
        device: to compute on.
        scene: its geometry and opacities stay, its colours are the start.
        cameras: the views that count.
        targets: the picture that each of them should show.
        options: of the solver.
        active: (N, M, 3) in Y, Co, Cg: the coefficients that may differ from 0; all by default.
        background: R, G, B behind the scene.
        progress: called with the steps done and their greatest number.
        fix_ac: chooses the AC coefficients that a file can hold, from the solution (N, M, 3) R, G, B, which it must not
            change, and from what the re-fit knows of them (:meth:`ColourRefit.worth`). The constant ones are then
            solved for again. If it returns the solution itself, that stays as it is.
        help_from: workers that do some of the views; the targets are then pictures of a scene.
        colour_grid: in place of ``fix_ac``, where colours are rounded to steps of their splats, in rounds
            (:mod:`potr_cl.stages.refitting.rounding`): it gets :meth:`ColourRefit.worth_of_constants`, in a thread of
            its own, and returns the steps.

    Raises:
        UsageError: no camera.
        DeviceError: the scene does not fit the device.
    """
    options = options or RefitOptions()
    more = 0 if fix_ac is None and colour_grid is None else _CONSTANT_STEPS

    def report(done: int, steps: int) -> None:
        if progress is not None:
            progress(done, steps + more)

    with ColourRefit(
        device,
        scene,
        cameras,
        background=background,
        memory=options.memory,
        help_from=help_from,
        slices=options.slices,
    ) as refit:
        way: _Rounding
        if colour_grid is not None:
            way = _OnGrid(refit, targets, options, colour_grid)
        elif fix_ac is not None:
            way = _AsTheFileDoes(refit, targets, options, fix_ac)
        else:
            return refit.solve(scene.sh, targets, options, active, progress=report)
        solved = refit.solve_on_device(
            scene.sh, targets, options, active, progress=report, check=False, after_start=way.begin
        )
        result, at_start = way.finish(solved)
        # How good the solution was, the next one has measured at its start: that saves a sweep. Only if it looks bad is
        # it measured by itself, because the rounding may be what was bad. Where many colours were cut at 0 on the way,
        # it is the solution.
        if not at_start <= solved.worst and not way.error() <= solved.worst:
            solved = refit.solve_on_device(scene.sh, targets, options, active, progress=report, after_start=way.begin)
            result, _ = way.finish(solved)
        return result


class _Rounding(Protocol):
    """What becomes of a solution's AC coefficients, and of the constant ones then."""

    def begin(self) -> None:
        """Called when the splats' blocks are known."""
        ...

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        """Round, and solve for the constant coefficients; also the error between the two."""
        ...

    def error(self) -> float:
        """Of the solution, before it was rounded."""
        ...


@dataclass
class _OnGrid:
    """Rounded on the device, to steps that are found while it solves."""

    refit: ColourRefit
    targets: Targets
    options: RefitOptions
    colour_grid: Callable[[FloatArray], ColourGrid]
    _grid: Future[ColourGrid] | None = None

    def begin(self) -> None:
        self._grid = in_background(self.colour_grid, self.refit.worth_of_constants())

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        assert self._grid is not None
        rounded = self.refit.round_to(self._grid.result(), self.targets, self.options)
        result = Refitted(self.refit.colours(), (solved.errors[0], rounded.errors[1]), solved.steps + rounded.steps)
        return result, rounded.errors[0]

    def error(self) -> float:
        return self.refit.error(self.targets)


@dataclass
class _AsTheFileDoes:
    """Rounded on the host, in whatever way a kind of file has."""

    refit: ColourRefit
    targets: Targets
    options: RefitOptions
    fix_ac: Callable[[FloatArray, ColourRefit], FloatArray]
    _found: FloatArray | None = None

    def begin(self) -> None:
        pass

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        self._found = self.refit.colours()
        fixed = self.fix_ac(self._found, self.refit)
        if fixed is self._found:
            error = self.error() if math.isnan(solved.errors[1]) else solved.errors[1]
            return Refitted(fixed, (solved.errors[0], error), solved.steps), error
        again = self.refit.solve_constant(self.targets, replace(self.options, steps=_CONSTANT_STEPS), fixed)
        sh = self.refit.colours()
        sh[:, 1:] = fixed[:, 1:]  # they were rounded once more on their way through Y, Co, Cg
        return Refitted(sh, (solved.errors[0], again.errors[1]), solved.steps + again.steps), again.errors[0]

    def error(self) -> float:
        return self.refit.error(self.targets, self._found)


@dataclass(frozen=True)
class HelpFrom:
    """Workers that do some of the views of a re-fit.

    Attributes:
        pool: the workers.
        source: the scene whose pictures are the targets, perhaps kept on devices, or with pictures of it there; or who
            does which views, and has what these see of it.
    """

    pool: Pool
    source: Scene | KeptScene | PicturesAhead | ViewShares

    def shares(self, views: int) -> Shares:
        """Who does which of so many views.

        Raises:
            WorkerLost: no worker is left.
        """
        if isinstance(self.source, ViewShares):
            return Shares([], [share.numbers for share in self.source.shares])
        return colour_shares(self.pool, views)


class ColourRefit(Owner):
    """The map and the solver of one scene, for any number of solutions.

    Args:
        device: to compute on.
        scene: whose geometry, opacities and SH degree are used.
        cameras: the views that count, all the same whatever their size.
        rules, background: of the rasterizer.
        memory: bytes of device memory that prepared views and targets may take, together with the vectors where these
            take much; None: views take a quarter of what is free.
        help_from: workers that do some of the views.
        slices: as of :class:`RefitOptions`.

    Attributes:
        coefficients, colour_map: the vectors and the map, for callers that want products rather than solutions.

    Raises:
        UsageError: no camera.
        DeviceError: the scene or a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        cameras: Sequence[Camera],
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
        help_from: HelpFrom | None = None,
        slices: int | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("a re-fit needs at least one view")
        with ExitStack() as owned:
            own, others = None, None
            if help_from is not None:
                share = help_from.shares(len(cameras))
                if share.others:
                    own = share.own
                    others = owned.enter_context(
                        colour_parts(
                            help_from.pool, share, scene, rules, background, help_from.source, cameras, memory
                        )
                    )  # fmt: skip
            # The rasterizer's own colours are never looked at.
            rasterizer = owned.enter_context(Rasterizer(device, replace(scene, sh=scene.sh[:, :1]), rules))
            launcher = launcher_for(device, rules)
            layout = Layout(len(scene), rasterizer.stride, scene.sh.shape[1], launcher.lanes)
            # The vectors come first: prepared views can do with less memory, and only take longer then.
            place = placed(device, layout.splats, layout.sh_count, memory, slices) if others is None else None
            if place is not None:
                memory = place.views
            elif others is None:
                memory = left_for_views(layout.splats, layout.sh_count, memory)
            self.coefficients = owned.enter_context(vectors_of(device, layout, place))
            blocks = blocks_of(self.coefficients, place)
            owned.callback(blocks.close)
            self._solver = ColourSolver(self.coefficients, blocks)
            helpers = None
            if help_from is not None and others is not None:
                assert isinstance(self.coefficients, Coefficients)
                in_process = help_from.pool.in_process
                helpers = owned.enter_context(SharedViews(self.coefficients, others, in_process))
            self.colour_map = owned.enter_context(
                ColourMap(
                    launcher, rasterizer, self.coefficients, scene.means, cameras, background, memory, own, helpers
                )
            )
            self._unrounded: Vector | None = None
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

        Raises:
            DeviceError: the device failed.
        """
        solved = self.solve_on_device(sh, targets, options, active, hold, progress)
        return Refitted(self.colours(), solved.errors, solved.steps)

    def solve_on_device(
        self,
        sh: FloatArray,
        targets: Targets,
        options: RefitOptions,
        active: NDArray[np.bool_] | None = None,
        hold: bool = False,
        progress: Callable[[int, int], None] | None = None,
        check: bool = True,
        after_start: Callable[[], None] = lambda: None,
    ) -> Solved:
        """The same, with the solution left where :meth:`colours`, :meth:`round_to` and :meth:`solve_constant` find it.

        Args:
            sh, targets, options, active, hold, progress: as :meth:`solve` takes them.
            check: measure the error of the solution, and keep the start if that was better; if not, that error is not a
                number.
            after_start: called when :meth:`worth` and its likes are known.

        Raises:
            DeviceError: the device failed.
        """
        coefficients, solver = self.coefficients, self._solver
        coefficients.write_sh(solver.x, sh)
        coefficients.make_room()
        coefficients.activate(active)
        if active is not None and not hold:
            coefficients.keep_active(solver.x)
        descent = Descent(options.steps, options.gain, Ridge(options.lam, options.chroma_factor, options.prior))
        selection, total = None, options.steps
        if options.drop:
            ridge = replace(descent.ridge, lam=options.selection_lam)
            selection = Selection(Descent(options.selection_steps, options.gain, ridge, part=0), options.drop)
            total += options.selection_steps

        def after_step(steps: int) -> None:
            if progress is not None:
                progress(steps, total)

        return solver.solve(
            self.colour_map, targets, descent, selection, after_step, check=check, after_start=after_start
        )

    def solve_constant(self, targets: Targets, options: RefitOptions, sh: FloatArray | None = None) -> Solved:
        """Re-fit the constant coefficients alone, after a solution for nearly the same colours.

        Args:
            targets, options: as :meth:`solve` takes them; none are given up.
            sh: (N, M, 3) R, G, B, the start; None: the solution before, perhaps rounded. AC coefficients stay.

        Raises:
            DeviceError: the device failed.
        """
        coefficients, solver = self.coefficients, self._solver
        if sh is not None:
            coefficients.write_sh(solver.x, sh)
        coefficients.activate_constant()
        descent = Descent(options.steps, options.gain, Ridge(options.lam, options.chroma_factor, options.prior))
        return solver.solve(self.colour_map, targets, descent, constant=True)

    def colours(self) -> FloatArray:
        """(N, M, 3) float32 R, G, B, the solution."""
        return self.coefficients.read_sh(self._solver.x)

    def round_to(self, grid: ColourGrid, targets: Targets, options: RefitOptions) -> Solved:
        """Make of the solution what a file can hold, but for the last constant coefficients.

        :meth:`error` still knows what it was.

        Args:
            grid: what the file can hold.
            targets, options: that the solution was found with.

        Returns:
            The errors after the first round of rounding, and in the end.

        Raises:
            DeviceError: the device failed.
        """
        solver, steps, errors = self._solver, 0, []
        if self._unrounded is None:
            self._unrounded = self.coefficients.vector()
        self.coefficients.copy(self._unrounded, solver.x)
        ridge = Ridge(options.lam, options.chroma_factor, options.prior)
        worth = _WORTH * options.drop * self.colour_map.total_weight
        with rounding_of(self.coefficients, solver.blocks, grid) as round_some:
            *first, last = ROUNDS
            for each in first:
                round_some(solver.x, each, worth)
                gone_on = solver.go_on(self.colour_map, targets, Descent(each.steps, 0.0, ridge, part=0))
                steps += gone_on.steps
                errors.append(gone_on.start)
            round_some(solver.x, last, worth)
            solved = solver.solve(self.colour_map, targets, Descent(last.steps, 0.0, ridge, part=1), constant=True)
        return Solved((errors[0], solved.errors[1]), steps + solved.steps, solved.start)

    def error(self, targets: Targets, sh: FloatArray | None = None) -> float:
        """Mean squared error of the pictures. The solution is lost.

        Args:
            targets: the pictures.
            sh: (N, M, 3) R, G, B, the colours; None: the solution as it was before :meth:`round_to`.

        Raises:
            DeviceError: the device failed.
        """
        if sh is not None:
            self.coefficients.write_sh(self._solver.x, sh)
        else:
            assert self._unrounded is not None
            self.coefficients.copy(self._solver.x, self._unrounded)
        return self._solver.error(self.colour_map, targets)

    def worth_of_constants(self) -> FloatArray:
        """(N,) float32: :meth:`worth` of the constant coefficients."""
        return self._solver.blocks.constants() / np.float32(self.colour_map.total_weight)

    def worth(self) -> FloatArray:
        """(N, M) float32: by how much the mean squared error grows for an error of 1 in a coefficient of one channel.

        As the last solution has found it at its start; errors of different coefficients are taken as independent.
        """
        return self._solver.blocks.diagonals() / np.float32(self.colour_map.total_weight)

    def blocks(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32: the same for errors of a splat's coefficients together, upper triangles."""
        return self._solver.blocks.packed() / np.float32(self.colour_map.total_weight)

    def active(self) -> NDArray[np.bool_]:
        """(N, M, 3) in Y, Co, Cg: the coefficients that the last solution left active."""
        return self.coefficients.is_active()

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()


def active_coefficients(sh: FloatArray, sf_sh: float) -> NDArray[np.bool_]:
    """(N, M, 3) the coefficients in Y, Co, Cg that the quantiser would not round to 0; DC always.

    Args:
        sh: (N, M, 3) R, G, B.
        sf_sh: the quantiser's scale factor.
    """
    active = nonzero_levels(sh, sf_sh)
    active[:, 0] = True
    return active
