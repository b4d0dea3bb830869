"""Does a fit of all parameters make a better file? Where that is in doubt, :func:`only_if_it_pays` makes both.

The fit judges itself before anything is rounded. What it gains can be lost again when the file is made: coefficients
that were 0 are not any more, the re-fit of the colours would have mended most of what it mends, and errors far below
those of rounding count for nothing. So where the gain is small, the remaining stages are run with the fit and without
it. The views that the fit held out compare the two files: the re-fit of the colours has looked at them in both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.fit import LeftOut
from potr_cl.stages.fitting.files import File, TwoFiles
from potr_cl.stages.fitting.fit import Fitted, held_out_error
from potr_cl.stages.stage import State
from potr_cl.views.targets import RenderedTargets

_NO_SMALLER = "on the views that were held out, a file with it was no better than one without"


@dataclass(frozen=True)
class Trial:
    """What the two files are made and judged with.

    Attributes:
        remaining: the stages after the fit, up to the one that makes the file.
        output: the kind of file.
        device: that judges.
        source: the uncompressed scene, as it may lie there.
        background: R, G, B behind the scene.
    """

    remaining: Callable[[State], State]
    output: Output
    device: Device
    source: Drawable
    background: tuple[float, float, float]

    def of(self, state: State) -> File:
        """The file that a state becomes, and how well it shows the views that a fit holds out."""
        coded = self.remaining(state).learnt.coded
        assert coded is not None, "the last stage makes the file"
        with (
            self.output.seen(b"".join(coded.pieces), self.device, trust=True) as seen,
            Rasterizer(self.device, self.source, background=self.background) as rasterizer,
        ):
            targets = RenderedTargets(rasterizer, state.views)
            error = held_out_error(self.device, seen, state.views, targets, state.added, self.background)
        return File(coded.nbytes, error)


def only_if_it_pays(before: State, after: State, trial: Trial) -> State:
    """The state after a fit, or that before it where a file with the fit would be no better.

    Args:
        before, after: the fit. ``after`` is returned as it is where the fit was left out, was interrupted, gained much,
            or went on to photographs, which are judges of their own.
        trial: makes the files.

    Returns:
        One of the two; what both files came to is told with what the fit says of itself.

    Raises:
        As the stages.
    """
    told = after.learnt.fitted
    if not isinstance(told, Fitted) or not told.in_doubt or told.ended_early or told.photographs is not None:
        return after
    left_out = LeftOut(_NO_SMALLER)
    try:
        files = TwoFiles(trial.of(before.having_learnt(fitted=left_out)), trial.of(after))
    except DeviceMemoryError:  # where there is no room to compare files, the fit's own judgement has to do
        return after
    if files.pays:
        return after.having_learnt(fitted=dataclasses.replace(told, files=files))
    return before.having_learnt(fitted=dataclasses.replace(left_out, files=files))
