"""Views dealt out to computers, each of which gets of a large scene what its views may draw: :class:`ViewShares`.

Pictures, and what a view measures, are the same bits with these splats as with all: those left out reach no pixel, and
the others keep their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import Indices
from potr_cl.raster.resident import SceneSubset
from potr_cl.views.visibility import Visibility
from potr_cl.workers.pool import Pool, Shares

if TYPE_CHECKING:
    from potr_cl.raster.resident import ResidentScene
    from potr_cl.views.targets import PicturesAhead


@dataclass(frozen=True)
class ViewShare:
    """What one of them does, and gets.

    Attributes:
        numbers: of its views, ascending.
        splats: (n,) int64, the numbers of the splats that these may draw, ascending, in the scene that is worked on.
        subset: these splats, whose places are their numbers from now on.
        visibility: what all views may draw of them.
    """

    numbers: list[int]
    splats: Indices
    subset: SceneSubset
    visibility: Visibility


@dataclass(frozen=True)
class ViewShares:
    """All views, dealt out.

    Attributes:
        views: all views.
        shares: who does which of them; each has some.
        names: of those that do them, in the same order.
    """

    views: Sequence[Camera]
    shares: tuple[ViewShare, ...]
    names: tuple[str, ...] = ()

    @property
    def dealt(self) -> Shares:
        """Who does which: the master none."""
        return Shares([], [share.numbers for share in self.shares], self.names)

    @staticmethod
    def of(
        views: Sequence[Camera],
        visibility: Visibility,
        speeds: Sequence[float],
        source: Scene,
        numbers: Indices,
        names: Sequence[str] = (),
    ) -> ViewShares:
        """Deal views out, neighbours to the same.

        Args:
            views: at least one.
            visibility: what they see of the scene that is worked on.
            speeds: of those that are to do them.
            source: a scene that has that one's splats as they are.
            numbers: (N,) of these there, ascending.
            names: of those that are to do them.
        """
        shares: list[ViewShare] = []
        busy: list[str] = []
        for place, own in enumerate(visibility.dealt(speeds)):
            if own:
                busy += names[place : place + 1]
                splats, of_these = visibility.of_views(own)
                shares.append(ViewShare(own, splats, SceneSubset(source, numbers[splats]), of_these))
        return ViewShares(views, tuple(shares), tuple(busy))


@dataclass
class HelpFrom:
    """Workers that do some of the views.

    Attributes:
        source: the scene whose pictures are the targets, perhaps kept on devices, or with pictures of it there; or who
            does which views, and has what these see of it.
        visibility: what the views may draw of the source, where it is the same for all workers, and where no view sees
            much of it.
        slower: whether a work took longer with them than without, so that the next ones of the kind do without.
    """

    pool: Pool
    source: Scene | ResidentScene | PicturesAhead | ViewShares
    visibility: Visibility | None = None
    slower: bool = False
