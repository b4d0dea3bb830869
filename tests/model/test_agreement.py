"""Do cameras belong to a scene? Wrong frames are found, right ones are never refused."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from potr_cl import Camera, Scene, UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.agreement import judge_cameras, require_agreement
from potr_cl.model.camera import train_views
from potr_cl.model.sightings import looked_at
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.evidence import evidence_of
from tests.reference.captures import CAPTURES
from tests.reference.frames import MISREADINGS, MOTIONS, looking_back, moved, right, without_directions, wrong
from tests.reference.raster import sh_basis
from tests.reference.scenes import ring_of_cameras


@pytest.fixture(scope="module")
def plush_views(data):
    return train_views(load_cameras(data / "plush_cameras.json"))


#: Of another scene: all around the origin.
ELSEWHERE = train_views(ring_of_cameras(24, 4.0, 200))


@pytest.mark.parametrize("degree", [3, 0])
def test_every_wrong_frame_of_the_excerpt_is_found(plush_excerpt, plush_excerpt_cameras, degree):
    scene, views = of_degree(plush_excerpt, degree), train_views(plush_excerpt_cameras)
    judged = {what: judge_cameras(other, cameras) for what, other, cameras in wrong(scene, views, ELSEWHERE)}
    assert len(judged) >= 9
    # It lies beside the origin, so every motion takes it away from where the cameras look.
    assert [what for what, each in judged.items() if not each.suspicious] == []
    for what in ("turned by 180 degrees about x", "scaled by 10", "scaled by 0.1"):
        assert degree == 0 or judged[what].motion.name == what


@pytest.mark.slow
def test_no_right_cameras_of_the_excerpt_are_refused(plush_excerpt, plush_excerpt_cameras):
    # Whoever stands within it sees nothing: it is no larger than the renderer's near plane is far.
    own = right(plush_excerpt, train_views(plush_excerpt_cameras), others=False)
    for what, cameras in [*own, ("virtual cameras", place_cameras(plush_excerpt, 12))]:
        for scene in (plush_excerpt, without_directions(plush_excerpt)):
            assert not judge_cameras(scene, cameras).suspicious, (what, scene.sh_degree)


@pytest.mark.parametrize("degree", [3, pytest.param(0, marks=pytest.mark.slow)])
def test_an_excerpt_belongs_to_the_cameras_of_the_whole_scene(plush_excerpt, plush_views, degree):
    """It is nearly nothing of any picture, and all of them see it."""
    scene = of_degree(plush_excerpt, degree)
    for what, cameras in right(scene, plush_views, others=False):
        assert not judge_cameras(scene, cameras).suspicious, what


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lego", "plush"])
def test_parts_that_are_cut_out_of_a_scene_belong_to_its_cameras(name, request):
    scene, views = whole(request, name)
    rng = np.random.default_rng(0)
    for splats in (1500, 10_000, 50_000):
        distance = np.linalg.norm(scene.means - scene.means[rng.integers(len(scene))], axis=1)
        part = scene.subset(np.sort(np.argsort(distance, kind="stable")[:splats]))
        judged = judge_cameras(part, views)
        # Of a wall behind most cameras, a quarter is out of all pictures, and the colours know few of the views.
        assert not judged.suspicious or judged.fit.seen < 0.8, splats


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lego", "plush"])
def test_every_wrong_frame_of_a_whole_scene_is_found(name, request):
    scene, views = thinned(request, name)
    others = whole(request, "plush" if name == "lego" else "lego")[1]
    found = {}
    for what, other, cameras in wrong(scene, views, others):
        if what in ("turned by 180 degrees about y", "turned by 90 degrees about x", "shifted by 8 along y"):
            continue  # the excerpt tells these, too
        judged = judge_cameras(other, cameras, evidence_of(other, cameras))
        # Of views that show next to nothing no photograph can tell.
        assert judged.suspicious or ("shifted" in what and judged.doubt), what
        found[what] = judged.motion and judged.motion.name
    for what in ("turned by 180 degrees about x", "scaled by 10", "scaled by 0.1"):
        assert found[what] == what
    assert found["cameras with the axes of OpenGL"] == "behind its cameras"
    for what, misread in MISREADINGS.items():
        judged = judge_cameras(scene, [misread(camera) for camera in views])
        assert judged.suspicious, what
        assert judged.motion.misread is not None, what


def test_cameras_of_other_conventions_are_called_so():
    scene, cameras = CAPTURES["facade"]()
    assert not judge_cameras(scene, cameras).suspicious
    for misread, condition, remedy in (
        (looking_back, "if each camera's y and z axes are turned round", "cameras with x right, y down, z forward"),
        (MISREADINGS["rotations written world to camera"], "rotation is transposed", "the transpose of each"),
        (MISREADINGS["poses written world to camera"], "pose is inverted", "the inverse of each matrix"),
        (MISREADINGS["translations written as positions"], "position is the translation t", "-R^T t"),
    ):
        judged = judge_cameras(scene, [misread(camera) for camera in cameras])
        assert judged.suspicious
        assert condition in judged.finding
        assert remedy in judged.remedy


def test_views_that_show_nothing_are_told_and_the_others_taken(plush_excerpt, plush_excerpt_cameras, caplog):
    views = [looking_back(camera) if number % 4 == 1 else camera for number, camera in enumerate(plush_excerpt_cameras)]
    judged = judge_cameras(plush_excerpt, views)
    assert not judged.suspicious
    assert set(judged.empty) == {camera.name for camera in plush_excerpt_cameras[1::4]}
    require_agreement(plush_excerpt, views)
    assert [record.getMessage() for record in caplog.records] == [judged.doubt]
    assert f"{len(judged.empty)} of {judged.views} views" in judged.doubt
    assert judged.empty[0] in judged.doubt


def test_a_view_of_what_the_sample_leaves_out_is_not_empty(plush_excerpt, plush_excerpt_cameras):
    """Of a large scene a view may show some splats only, and the sample none of them."""
    many = plush_excerpt.subset(np.zeros(100_000, int))
    far = dataclasses.replace(many, means=many.means + np.float32(100))
    judged = judge_cameras(far, plush_excerpt_cameras)
    assert len(judged.empty) == judged.views
    some = np.r_[1:4:2]  # too few and at places that the sample leaves out
    far.means[some] = plush_excerpt.means[some]
    assert judge_cameras(far, plush_excerpt_cameras).empty == ()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "degree"), [("lego", 3), ("plush", 0)])
def test_no_right_cameras_of_a_whole_scene_are_refused(name, degree, request):
    scene, views = thinned(request, name)
    scene = of_degree(scene, degree)
    for what, cameras in right(scene, views):
        assert not judge_cameras(scene, cameras).suspicious, what


@pytest.mark.slow
@pytest.mark.parametrize(("number", "name"), list(enumerate(CAPTURES)))
def test_no_right_cameras_of_other_kinds_of_scenes_are_refused(number, name):
    scene, cameras = CAPTURES[name]()
    scene = of_degree(scene, 0 if number % 2 else 3)
    for what, views in right(scene, cameras, others=False):
        assert not judge_cameras(scene, views).suspicious, (what, scene.sh_degree)


def test_the_same_is_judged_the_same(plush_excerpt, plush_excerpt_cameras):
    turned = moved(plush_excerpt, *MOTIONS["mirrored along z"])
    one, two = (judge_cameras(turned, plush_excerpt_cameras) for _ in range(2))
    assert (one.fit, one.moved, one.gain) == (two.fit, two.moved, two.gain)


def test_a_refusal_is_one_line_with_finding_and_ways_out(plush_excerpt, plush_excerpt_cameras):
    with pytest.raises(UsageError) as caught:
        require_agreement(moved(plush_excerpt, *MOTIONS["scaled by 0.1"]), plush_excerpt_cameras)
    message = str(caught.value)
    assert "\n" not in message
    for part in ("frame", "see", "was scaled by 0.1", "bring the scene back (scaled by 10)", "--cameras-anyway"):
        assert part in message
    require_agreement(plush_excerpt, plush_excerpt_cameras)


def test_views_that_see_nothing_are_refused_however_few(plush_excerpt, plush_excerpt_cameras):
    away = dataclasses.replace(plush_excerpt_cameras[0], translation=np.array([0.0, 0.0, -50.0]))
    judged = judge_cameras(plush_excerpt, [away])
    assert judged.blind
    assert judged.suspicious
    with pytest.raises(UsageError, match=r"see 0 % of the splats.*give the cameras of this scene"):
        require_agreement(plush_excerpt, [away])


@pytest.mark.parametrize("splats", [1, 2, 50])
def test_scenes_of_few_and_coinciding_splats(plush_excerpt, plush_excerpt_cameras, splats):
    few = plush_excerpt.subset(np.zeros(splats, int))
    assert not judge_cameras(few, plush_excerpt_cameras).suspicious
    with pytest.raises(UsageError):
        judge_cameras(few, [])


@pytest.mark.parametrize("value", [0.0, 1e-30, 3e38])
def test_values_at_the_ends_of_single_precision(plush_excerpt, plush_excerpt_cameras, value):
    """Whatever is said of them, it is said without an error or a warning."""
    scene = plush_excerpt.subset(np.arange(40))
    far = np.full_like(scene.means, value)
    far[::2] *= -1
    huge = np.full_like(scene.log_scales, np.log(max(value, 1e-38)))
    for other in (
        dataclasses.replace(scene, means=far),
        dataclasses.replace(scene, log_scales=huge),
        dataclasses.replace(scene, sh=np.full_like(scene.sh, value)),
    ):
        judge_cameras(other, plush_excerpt_cameras)


def test_a_moved_scene_looks_the_same_from_moved_cameras(plush_excerpt):
    """The float64 colours of the tests' own motion, seen from the place that moved along."""
    axes, direction = MOTIONS["turned by 90 degrees about x"][0], np.array([[0.3, -0.5, 0.8]]) / np.sqrt(0.98)
    before = np.einsum("dm,kmc->kc", sh_basis(direction, 3), plush_excerpt.sh)
    after = np.einsum("dm,kmc->kc", sh_basis(direction @ axes.T, 3), moved(plush_excerpt, axes).sh)
    np.testing.assert_allclose(after, before, atol=1e-5)


def of_degree(scene: Scene, degree: int) -> Scene:
    return scene if degree else without_directions(scene)


def thinned(request: pytest.FixtureRequest, name: str) -> tuple[Scene, list[Camera]]:
    """A whole scene's splats of which cameras are judged, and its views."""
    scene, views = whole(request, name)
    return scene.subset(looked_at(len(scene))), views


def whole(request: pytest.FixtureRequest, name: str) -> tuple[Scene, list[Camera]]:
    return loaded(request.getfixturevalue(name))


@functools.cache
def loaded(folder: Path) -> tuple[Scene, list[Camera]]:
    return load_scene(folder / "point_cloud.ply"), train_views(load_cameras(folder / "cameras.json"))
