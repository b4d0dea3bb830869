"""Splats that are left, each with what it and the removed ones nearest to it were together: :func:`merged`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.order import morton_order, over_ranges
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.scene_buffers import SPLAT_GROUP, Drawable, SceneBuffers, gathered, stride_of, uploaded

_Indices = NDArray[np.int64]
_U32 = NDArray[np.uint32]
_F32 = NDArray[np.float32]

_SOURCE = "merge/merge.cl"
#: By which the second curve is turned, about two axes: what is far apart on one is mostly near on the other.
_COS, _SIN = math.cos(0.7), math.sin(0.7)
_TURN = np.array([[_COS, -_SIN, 0], [_COS * _SIN, _COS * _COS, -_SIN], [_SIN * _SIN, _SIN * _COS, _COS]], np.float32)
#: Splats that a thread turns at a time; and that are merged at a time, but for a group of more.
_TURNED, _TOGETHER = 1 << 17, 1 << 20


def merged(
    device: Device, scene: Scene, left: _Indices, importance: _F32, run: Run = map, become: Scene | None = None,
    drawable: Drawable | None = None,
) -> Scene:  # fmt: skip
    """Splats that are left, each with what it and the removed ones nearest to it were together.

    Of each group the centre, the covariance, and the coefficients are the weighted means; the opacity is such that it
    covers as much as before. Only those are merged that miss most, or of which views show little (cl/merge/merge.cl).

    Args:
        device: that does it.
        scene: N splats.
        left: (n,) numbers of those that are left, ascending.
        importance: (N,) float32, what pictures show of each, in any unit.
        run: in place of :func:`map`, to work with several threads.
        become: the splats that are left as they are by now, which those stay that are not merged; None: as they were.
        drawable: the scene, where it lies on the device already.
    """
    found = scene.subset(left) if become is None else become.subset(np.arange(len(become)))
    with ExitStack() as stack:
        if isinstance(drawable, SceneBuffers):
            whole = drawable
        else:  # neighbours are told by their constant coefficients
            whole = stack.enter_context(uploaded(device, replace(scene, sh=scene.sh[:, :1])))
        memory = stack.enter_context(Memory(device))
        covers = memory.allocate(4 * len(scene), "what splats cover")
        kernel = device.shared_kernel(_SOURCE, "covers")
        kernel.bind(
            stride=whole.stride, scales=whole.scales, log2_opacities=whole.log2_opacities, count=len(scene),
            found=covers,
        ).launch((whole.stride,), (SPLAT_GROUP,))  # fmt: skip
        covered = device.download(covers, (len(scene),), np.float32)
        shown, covering = (float(values.sum(dtype=np.float64)) for values in (importance, covered))
        usual = min(shown / max(covering, 1e-30), 1e30) or 1.0
        group = groups_of(device, scene, left, run, whole)

        def in_groups(members: _Indices, _: int) -> None:
            members[:] = members[np.argsort(group[members], kind="stable")]

        members = over_ranges(group, in_groups, run)
        counts = np.bincount(group, minlength=len(left) + 1)[:-1]
        several = np.flatnonzero(counts > 1)
        starts = (np.cumsum(counts) - counts)[several]
        ends = np.cumsum(counts[several])
        cuts = np.searchsorted(ends, np.arange(_TOGETHER, ends[-1] if len(ends) else 0, _TOGETHER))
        for some in np.split(np.arange(len(several)), cuts):
            if not len(some):
                continue
            sizes = counts[several[some]]
            firsts = np.concatenate([[0], np.cumsum(sizes)])
            own = members[np.repeat(starts[some] - firsts[:-1], sizes) + np.arange(firsts[-1])]
            part = gathered(whole, own) if whole is drawable else uploaded(device, scene.subset(own))
            with part:
                kept = importance[left[several[some]]]
                _merge(part, several[some], firsts.astype(np.uint32), importance[own], covered[own], kept, usual, found)
    return found


def _merge(
    part: SceneBuffers, groups: _Indices, starts: _U32, importance: _F32, covered: _F32, kept: _F32, usual: float,
    found: Scene,
) -> None:  # fmt: skip
    """Set those of some groups that are to be merged.

    Args:
        part: the groups' splats one after another.
        groups: (g,) their numbers among all that are left.
        starts: (g + 1,) where each begins, and the end.
        importance, covered: of each splat. kept: (g,) the importance of those that are left.
        found: all that are left.
    """
    device, count, colours = part.device, len(groups), 3 * part.sh_count
    with Memory(device) as memory:
        what = "groups of splats"
        weights, which = (memory.allocate(4 * n, what) for n in (len(part), count))
        shapes, sums = (memory.allocate(4 * n * count, what) for n in (11, colours))
        begin = memory.upload(starts, what)
        shape = device.shared_kernel(_SOURCE, "merge_shapes")
        shape.bind(
            stride=part.stride, means=part.means, scales=part.scales, quaternions=part.quaternions,
            covered=memory.upload(covered, what), importance=memory.upload(importance, what),
            kept=memory.upload(kept, what), usual=usual, starts=begin, count=count, weights=weights, merged=which,
            found=shapes,
        ).launch((stride_of(count),), (SPLAT_GROUP,))  # fmt: skip
        mean = device.shared_kernel(_SOURCE, "merge_colours")
        mean.bind(
            stride=part.stride, sh=part.sh, weights=weights, merged=which, starts=begin, count=count, found=sums
        ).launch((stride_of(count), colours), (SPLAT_GROUP, 1))
        wanted = device.download(which, (count,), np.uint32) != 0
        columns = device.download(shapes, (11, count), np.float32)[:, wanted]
        places = groups[wanted]
        found.means[places] = columns[:3].T
        found.log_scales[places] = columns[3:6].T
        found.quaternions[places] = columns[6:10].T
        found.opacity_logits[places] = columns[10]
        sh = device.download(sums, (colours, count), np.float32)[:, wanted]
        found.sh[places] = sh.T.reshape(-1, part.sh_count, 3)


def groups_of(device: Device, scene: Scene, left: _Indices, run: Run, whole: SceneBuffers) -> _U32:
    """(N,) for each splat the place in ``left`` of the one that takes it over, or its own there; n if none does.

    The best of the neighbours along two Morton curves, one of which is turned, by distance, size and colour.

    Args:
        whole: the scene on the device; its constant coefficients are enough.
    """
    group = np.full(len(scene), len(left), np.uint32)
    group[left] = np.arange(len(left), dtype=np.uint32)
    is_left = group < len(left)
    turned = np.empty((len(scene), 3), np.float32)

    def turn(first: int) -> None:
        some = slice(first, first + _TURNED)
        np.einsum("ij,jk->ik", scene.means[some], _TURN, out=turned[some])  # BLAS' threads would wait for each other

    list(run(turn, range(0, len(scene), _TURNED)))
    kernel = device.shared_kernel(_SOURCE, "nearest")
    with Memory(device) as memory:
        groups = memory.upload(group, "groups of splats")
        costs = memory.allocate(4 * len(scene), "costs of neighbours")
        device.fill(costs, np.float32(np.inf))
        for means in (scene.means, turned):
            order = morton_order(means, run)
            stays = is_left[order]
            curve, gone = (order[which].astype(np.uint32) for which in (stays, ~stays))
            if not len(gone) or not len(curve):
                break
            places = np.cumsum(stays, dtype=np.uint32)[~stays]
            with Memory(device) as passing:
                kernel.bind(
                    stride=whole.stride, means=whole.means, scales=whole.scales, sh=whole.sh,
                    curve=passing.upload(curve, "splats along a curve"), left=len(curve),
                    gone=passing.upload(gone, "removed splats"), places=passing.upload(places, "their places"),
                    count=len(gone), least=costs, groups=groups,
                ).launch((stride_of(len(gone)),), (SPLAT_GROUP,))  # fmt: skip
        found: _U32 = device.download(groups, (len(scene),), np.uint32)
        return found
