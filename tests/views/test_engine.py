"""The engine looks at every view of a plan, resident or streamed, with splats that show what the whole scene shows."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest

from potr_cl.opencl.memory import Memory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.views.budget import KnownBudget, ViewCache
from potr_cl.views.engine import ViewEngine
from potr_cl.views.plan import ViewPlan, in_launches
from potr_cl.views.subsets import CopiedSplats, WholeScene
from potr_cl.views.visibility import ViewGroup
from tests.devices import FAMILIES, shared_device
from tests.reference.scenes import ring_of_cameras, visible_scene

SCENE, CAMERAS = visible_scene(60, 1), ring_of_cameras(9, size=32)
ALL = np.arange(len(SCENE))
BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = shared_device(request.param)
    yield device
    assert device.allocated == 0, "not all memory was given back"


class Views:
    """A use that keeps its views, and nothing else."""

    nbytes = 0

    def __init__(self, numbers, subset, views, memory, target):
        self.close = views.close


def picture(device, rasterizer, views):
    pixels = sum(view.camera.width * view.camera.height for view in views.views)
    buffer = device.allocate(12 * pixels, "pictures")
    rasterizer.pictures_into(views, buffer)
    found = device.download(buffer, (pixels, 3), np.float32)
    device.free(buffer)
    return found


@pytest.mark.one_family
@pytest.mark.parametrize(
    ("memory", "picture", "wanted"), [(480_000, 5200, [3, 3, 1]), (480_000, 0, [6, 1]), (0, 9, [1] * 7)]
)
def test_a_launch_takes_a_sixteenth_of_the_memory_with_its_pictures(device, memory, picture, wanted):
    """Of 7 views of 100 splats, 48 bytes each."""
    with ViewCache(device, memory) as cache:
        plan = in_launches(range(7), dict.fromkeys(range(7), 100), cache, 128, 0, picture)
    assert [len(group.numbers) for group in plan.groups] == wanted


@pytest.mark.parametrize("memory", [0, 1 << 24], ids=["streamed", "resident"])
@pytest.mark.parametrize("copied", [False, True], ids=["all splats", "copies"])
def test_every_view_is_walked_once_and_shows_the_scene(device, memory, copied):
    most = 1 if device.family == "cpu" else 2  # of views in a launch
    with ExitStack() as stack:
        whole = stack.enter_context(Rasterizer(device, SCENE))
        if copied:
            groups = [ViewGroup((number,), len(SCENE), among=ALL, nbytes=1) for number in range(len(CAMERAS))]
            source = CopiedSplats(device, SCENE, SCENE, BLACK)
            plan = ViewPlan(groups, KnownBudget(memory), singly=True)
        else:
            cache = stack.enter_context(ViewCache(device, memory))
            strides = dict.fromkeys(range(len(CAMERAS)), whole.stride)
            source, plan = WholeScene(whole), in_launches(range(len(CAMERAS)), strides, cache, most, 0, 0)
        with ViewEngine(source, CAMERAS, plan, Views, most) as engine:
            launches = engine.walk()
            assert sorted(number for each in launches for number in each.numbers) == list(range(len(CAMERAS)))
            assert {each.resident is not None for each in launches} == {memory > 0}
            for launch in launches:
                with engine.ready(launch) as ready:
                    found = picture(device, ready.subset.rasterizer, ready.views)
                wanted = [whole.render(CAMERAS[number])[0].reshape(-1, 3) for number in launch.numbers]
                assert np.array_equal(found, np.concatenate(wanted))


def test_a_copy_that_rests_is_back_in_the_colours_of_now_for_a_projection(device):
    other = SCENE.sh[::-1].copy()
    with (
        CopiedSplats(device, SCENE, SCENE, BLACK) as source,
        Rasterizer(device, SCENE) as whole,
        Memory(device) as memory,
        ExitStack() as stack,
    ):
        subset = source.open(stack, memory, ViewGroup((0,), len(SCENE), among=ALL))
        with subset.rasterizer.prepare_set(CAMERAS[:1]) as views:
            source.rest(subset)
            source.replace_sh(other)
            source.project(subset, views)
            found = picture(device, subset.rasterizer, views)
        device.free(whole.replace_sh(other))
        assert np.array_equal(found, whole.render(CAMERAS[0])[0].reshape(-1, 3))
    assert not np.array_equal(SCENE.sh, other)
