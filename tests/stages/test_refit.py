"""The joint re-fit of the colours against float64: the linear map, its transpose, the solution, the selection."""

from __future__ import annotations

import dataclasses
import threading
from functools import partial

import numpy as np
import pytest

from potr_cl.errors import DataError, UsageError
from potr_cl.model.scene import MIP_SPLATTING_LOW_PASS, Scene
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import active_coefficients, refit_colours
from potr_cl.stages.refitting.refit_options import ComingScene, RefitOptions
from potr_cl.stages.refitting.sliced_arrays import Ridge
from tests.cases.memory import taken_of
from tests.cases.scenes import antialiased
from tests.reference.refit import LENGTHS, selection, to_rgb, to_ycocg
from tests.reference.refit_cases import Case, Linearised, Pictures, as_rows
from tests.reference.rounding import grid_of
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene


def relative(a, b) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def crowd() -> Scene:
    """More splats in a tile than CPU kernels take at a time, 1536."""
    scene = visible_scene(2000, 1)
    scene.log_scales[:] = -4.5
    scene.opacity_logits[:] = -3.5
    return scene


def hiding() -> Scene:
    """Most splats lie behind where all pixels of a tile have ended."""
    scene = visible_scene(90, 1)
    scene.log_scales[:] = -0.5
    scene.opacity_logits[:] = 2.0
    return scene


def dim(degree: int) -> Scene:
    """Half of the colours are cut at 0."""
    scene = visible_scene(40, degree, seed=degree)
    scene.sh[:, 0] -= np.float32(0.7 / 0.28)
    return scene


@pytest.mark.parametrize(
    ("make", "least_cut"),
    [
        pytest.param(lambda: dim(0), 0.3, id="dim, degree 0"),
        pytest.param(lambda: visible_scene(40, 1, seed=1), 0, id="degree 1"),
        pytest.param(lambda: dim(2), 0.3, id="dim, degree 2"),
        pytest.param(lambda: visible_scene(40, 3, seed=3), 0, id="degree 3"),
        pytest.param(lambda: dim(3), 0.3, id="dim, degree 3"),
        pytest.param(lambda: antialiased(visible_scene(40, 3, seed=1)), 0, id="antialiased"),
        pytest.param(lambda: antialiased(visible_scene(40, 3, seed=1), MIP_SPLATTING_LOW_PASS), 0, id="a small filter"),
        pytest.param(hiding, 0, id="most are hidden"),
        pytest.param(crowd, 0, id="long lists", marks=pytest.mark.slow),
    ],
)
def test_the_map_and_its_transpose(device, make, least_cut):
    """A, written out in float64, for random coefficients and pictures."""
    scene = make()
    cameras = ring_of_cameras(3, size=40) if len(scene) < 100 else ring_of_cameras(1, size=16)
    rng = np.random.default_rng(scene.sh_degree)
    with Case(device, scene, scene, cameras) as case:
        reference = case.reference()
        targets = [(p - rng.uniform(-1, 1, size=p.shape)).astype(np.float32) for p in case.pictures]
        rendered = reference.pictures(reference.start)
        images = [p - t.reshape(-1, 3) for p, t in zip(rendered, targets, strict=True)]
        directions = [rng.normal(size=scene.sh.shape) * length for length in (1, 1e-12, 1e12)]
        with Pictures(device, targets) as buffers, Linearised(case, buffers) as linear:
            normals = [linear.normal(direction) for direction in directions]
            assert not linear.normal(0 * directions[0]).any()
            assert linear.error_alone(buffers) == linear.error
        weighted = zip(reference.views, images, strict=True)
        assert linear.error == pytest.approx(sum(view.weight * np.sum(a * a) for view, a in weighted), rel=1e-5)
        assert relative(linear.gradient, reference.transposed(images)) < 1e-5
        for direction, normal in zip(directions, normals, strict=True):
            assert relative(normal, reference.transposed(reference.forward(direction))) < 1e-5
        wanted = reference.gram()
        assert np.abs(linear.blocks - wanted).max() < 1e-5 * wanted.max()
        cut = 1 - np.mean([free.mean() for free in reference.free])
        assert least_cut <= cut < (0.95 if least_cut else 0.3)


def products(case: Case, weights: bool) -> tuple[np.ndarray, int]:
    """That of a random direction after a gradient, perhaps with weights; and how many sub-tiles the lists name."""
    with ColourRefit(case.device, case.scene, case.cameras) as refit:
        vectors, own = refit.coefficients, refit.colour_map.own
        x, direction, result = (vectors.vector() for _ in range(3))
        vectors.write_sh(x, case.scene.sh)
        vectors.zero(result)
        refit.colour_map.gradient(x, case.targets, result, refit.solver.blocks if weights else None)
        values = np.random.default_rng(0).normal(size=(vectors.layout.columns, len(case.scene)))
        vectors.write(direction, values)
        refit.colour_map.normal(direction, result, x, Ridge(0.0, 0.0, 0.0))
        named = 0
        for each in own._launches if case.device.family == "cpu" else ():
            views = each.launch.resident.views
            found = case.device.download(views.subtiles, (views.read_counts()[0],), np.uint32)
            named += int(np.bitwise_count(found).sum())
        return vectors.read(result), named


def test_lists_lose_what_lies_behind_the_ends_and_no_bit_changes(device):
    with Case(device, hiding(), hiding(), ring_of_cameras(3, size=40)) as case:
        (whole, all_named), (trimmed, named) = (products(case, weights) for weights in (False, True))
    assert np.array_equal(whole, trimmed)
    assert named < 0.7 * all_named or device.family == "gpu"


def test_coefficients_that_no_splat_nearby_may_change_are_left_out_and_no_bit_changes(device):
    """Of the first splats all may change, of the others fewer and fewer."""
    scene = visible_scene(90, 3)
    active = np.random.default_rng(0).random(scene.sh.shape) * 60 > np.arange(90)[:, None, None] - 20
    active[:, 0] = True
    active[60:, 1:] = False
    directions = np.random.default_rng(1).normal(size=scene.sh.shape) * active
    with Case(device, scene, scene, ring_of_cameras(9, size=40)) as case, Linearised(case) as linear:
        whole = linear.normal(directions)
        linear.activate(active)
        some = linear.normal(directions)
    assert np.array_equal(some, whole * active)


def test_shares_of_pixels(device):
    """What a splat has of its pixels when all change alike, by the definition; the preconditioner goes by it."""
    scene, nothing = visible_scene(60, 2), Ridge(0.0, 0.0, 0.0)
    same = np.zeros(scene.sh.shape)
    same[:, 0, 0] = 1
    residual = np.random.default_rng(0).normal(size=scene.sh.shape)
    with Case(device, scene, scene, ring_of_cameras(4, size=40)) as case:
        with ColourRefit(device, scene, case.cameras) as refit:
            vectors, blocks = refit.coefficients, refit.solver.blocks
            x, direction, result = (vectors.vector() for _ in range(3))
            vectors.write_sh(x, scene.sh)
            vectors.zero(result)
            refit.colour_map.gradient(x, case.targets, result, blocks)
            blocks.share(partial(refit.colour_map.normal, at=x, ridge=nothing, constant=True), direction, result)
            vectors.write(direction, residual.transpose(1, 2, 0).reshape(-1, len(scene)))
            blocks.precondition(direction, result, Ridge(0.0, 0.0, 1.0))
            found = as_rows(vectors, result)
        reference = case.reference()
        gram = reference.gram()
        everybody = reference.transposed(reference.forward(same))[:, 0, 0]
    seen = gram[:, 0, 0] > 0
    shares = np.ones(len(scene))
    shares[seen] = np.minimum(3 * gram[seen, 0, 0] / everybody[seen], 1) ** 0.25
    assert shares.min() < 0.7
    ones = np.eye(scene.sh.shape[1])
    for c, length in enumerate(LENGTHS):
        damping = 1e-5 * length * np.trace(gram, axis1=1, axis2=2)[:, None, None] / len(ones)
        wanted = np.linalg.solve(length * gram + (1 + damping) * ones, residual[:, :, c : c + 1])[..., 0]
        assert relative(found[:, :, c], shares[:, None] * wanted) < 1e-3


@pytest.mark.parametrize(
    ("scene", "every", "size"),
    [(visible_scene(60, 1), 2, (37, 21)), (visible_scene(60, 2), 4, (40, 40)), (crowd(), 4, (16, 16))],
)
def test_some_blocks_of_pixels_stand_for_all(device, scene, every, size, monkeypatch):
    """Which ones, moves on from view to view; by number among all, whatever a launch does together."""
    monkeypatch.setattr("potr_cl.stages.refitting.colour_map.ENOUGH", 5)
    cameras = [
        dataclasses.replace(each, width=size[0] - i % 2, height=size[1])
        for i, each in enumerate(ring_of_cameras(5, size=40))
    ]
    direction = np.random.default_rng(every).normal(size=scene.sh.shape)
    with Case(device, scene, scene, cameras) as case, Linearised(case) as linear:
        whole, some, again = (linear.normal(direction, each) for each in (1, every, every))
        reference = case.reference()
        images = reference.forward(direction)
        for number, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            rows, columns = np.divmod(np.arange(len(image)), camera.width)
            image[(columns // 4 + every // 2 * (rows // 4) + number) % every != 0] = 0
        wanted = every * reference.transposed(images)
    assert np.array_equal(some, again)
    assert relative(some, wanted) < 1e-5
    assert relative(some, whole) > 1e-2


@pytest.mark.parametrize("every", [2, 4])
def test_a_gradient_by_some_blocks(device, every, monkeypatch):
    """With its error; a GPU looks at all pixels for it."""
    monkeypatch.setattr("potr_cl.stages.refitting.colour_map.ENOUGH", 5)
    cameras = ring_of_cameras(5, size=37)
    scene = visible_scene(60, 1)
    with Case(device, scene, visible_scene(60, 3), cameras) as case, Linearised(case) as linear:
        found, error = linear.gradient_of_dc(case.targets, every)
        again = linear.gradient_of_dc(case.targets, every)
        whole, all_error = linear.gradient[:, 0], linear.error
        reference = case.reference()
        images = [-residual for residual in reference.residuals()]
        for number, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            rows, columns = np.divmod(np.arange(len(image)), camera.width)
            image[(columns // 4 + every // 2 * (rows // 4) + number) % every != 0] = 0
        wanted = every * reference.transposed(images)[:, 0]
        squares = [view.weight * (image**2).sum() for view, image in zip(reference.views, images, strict=True)]
    assert np.array_equal(found, again[0])
    assert error == again[1]
    if device.family == "gpu":
        assert np.array_equal(found, whole)
        assert error == all_error
        return
    assert relative(found, wanted) < 1e-5
    assert relative(found, whole) > 1e-2
    assert error == pytest.approx(every * sum(squares), rel=1e-5)


@pytest.mark.one_family
@pytest.mark.parametrize(("splats", "rounds", "wanted"), [(20, True, {2, 4}), (60, True, {1, 4}), (20, False, {1, 4})])
def test_steps_by_half_of_the_pixels_are_for_many_of_them_and_rounds_that_follow(
    device, splats, rounds, wanted, monkeypatch
):
    """3 views of 40 x 40 pixels are 240 for each of 20 splats. The choice of coefficients always has one in four."""
    asked, normal = set(), ColourMap.normal

    def noted(self, *args, **how):
        asked.add(how["every"])
        normal(self, *args, **how)

    monkeypatch.setattr(ColourMap, "normal", noted)
    options = RefitOptions(steps=2, gain=0, drop=1e-9)
    grid = {"colour_grid": lambda effects: grid_of(splats)} if rounds else {"fix_ac": lambda sh, refit: sh.copy()}
    scene = visible_scene(splats, 1)
    with Case(device, scene, scene, ring_of_cameras(3, size=40)) as case:
        refit_colours(device, scene, case.cameras, case.targets, options, **grid)
    assert asked == wanted


@pytest.mark.one_family
@pytest.mark.parametrize(("splats", "wanted"), [(40, {1, 2}), (60, {1})])
def test_the_last_gradient_is_by_half_of_many_pixels(device, splats, wanted, monkeypatch):
    """3 views of 40 x 40 pixels are 120 for each of 40 splats, and 80 of 60. Nobody measures what comes of it."""
    asked, gradient = list[int](), ColourMap.gradient

    def noted(self, x, targets, result, blocks=None, constant=False, every=1):
        assert constant or every == 1
        asked.append(every)
        return gradient(self, x, targets, result, blocks, constant, every)

    def measured(self, x, targets):
        raise AssertionError

    monkeypatch.setattr(ColourMap, "gradient", noted)
    monkeypatch.setattr(ColourMap, "error", measured)
    options, scene = RefitOptions(steps=2, gain=0, drop=1e-9), visible_scene(splats, 1)
    with Case(device, scene, visible_scene(splats, 3), ring_of_cameras(3, size=40)) as case:
        refit_colours(
            device, scene, case.cameras, case.targets, options, colour_grid=lambda effects: grid_of(splats)
        )  # fmt: skip
    assert set(asked) == wanted


def test_few_views_are_looked_at_whole(device):
    scene = visible_scene(40, 1)
    direction = np.random.default_rng(1).normal(size=scene.sh.shape)
    with Case(device, scene, scene, ring_of_cameras(3, size=40)) as case, Linearised(case) as linear:
        assert np.array_equal(linear.normal(direction, 4), linear.normal(direction))


@pytest.mark.parametrize(
    ("degree", "lam", "prior", "background", "most", "bound"),
    [(1, 30.0, 3.0, (1.0, 0.5, 0.0), 300, 1e-3), (3, 100.0, 10.0, (0.0, 0.0, 0.0), 300, 1e-3),
     # Steps end where single precision does.
     (2, 30.0, 10.0, (0.0, 0.0, 0.0), 99, 1e-4),
     pytest.param(0, 30.0, 10.0, (0.0, 0.0, 0.0), 99, 1e-4, marks=pytest.mark.slow)],
)  # fmt: skip
def test_the_solution_is_the_least_squares_one(device, degree, lam, prior, background, most, bound):
    scene, other = visible_scene(20, degree), visible_scene(60, 2, seed=7)
    with Case(device, scene, other, ring_of_cameras(3, size=40), background) as case:
        refitted = case.solve(RefitOptions(steps=300, gain=0, lam=lam, prior=prior))
        reference = case.reference(lam=lam, prior=prior)
    assert refitted.steps <= most
    solution, x = reference.solution(), to_ycocg(refitted.sh)
    assert np.linalg.norm(x - solution) < bound * np.linalg.norm(solution - reference.start)
    assert reference.objective(x) < 0.9 * reference.objective(reference.start)


def assert_solved(x, reference) -> None:
    solution = reference.solution()
    assert np.linalg.norm(x - solution) < 1e-3 * np.linalg.norm(solution - reference.start)


def test_inactive_coefficients_stay_zero_and_the_others_solve_their_own_problem(case):
    active = np.random.default_rng(3).random(case.scene.sh.shape) < 0.5
    active[:, 0] = True
    x = to_ycocg(case.solve(RefitOptions(steps=300, gain=0, lam=30, prior=10), active).sh)
    assert np.abs(x[~active]).max() < 1e-6
    assert_solved(x, case.reference(lam=30, prior=10, active=active))


def test_held_coefficients_keep_their_values(case):
    active = np.zeros(case.scene.sh.shape, bool)
    active[:10, 0] = True
    with ColourRefit(case.device, case.scene, case.cameras) as refit:
        options = RefitOptions(steps=100, gain=0, prior=10)
        x = to_ycocg(refit.solve(case.scene.sh, case.targets, options, active, hold=True).sh)
        assert np.array_equal(refit.active(), active)
    reference = case.reference(prior=10, active=active, hold=True)
    assert np.abs(x - reference.start)[~active].max() < 1e-6
    assert_solved(x, reference)


@pytest.mark.one_runtime
def test_it_stops_when_a_step_gains_too_little_and_tells_of_each(case):
    assert case.solve(RefitOptions(steps=50, gain=0.05)).steps < 20
    assert case.solve(RefitOptions(steps=0)).steps == 0
    told = []
    options = RefitOptions(steps=3, gain=0)
    with ColourRefit(case.device, case.scene, case.cameras) as refit:
        refit.solve(case.scene.sh, case.targets, options, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("coming", [False, True], ids=["a scene that is there", "a scene that is still to come"])
def test_solutions_of_one_map_do_not_depend_on_each_other(case, coming):
    """Other targets, options and starts in between, the first of them the scene's or not: the same bytes as by itself.

    Of a scene that is still to come the colours are on the device before its geometry is there.
    """
    options, few = RefitOptions(steps=3, gain=0, drop=1e-7), RefitOptions(steps=1)
    dimmed = dataclasses.replace(case.scene, sh=0.5 * case.scene.sh)
    scene, begun = case.scene, threading.Event()
    if coming:
        scene = ComingScene(case.scene.sh, lambda: begun.wait(300) and case.scene)
        threading.Timer(0.2, begun.set).start()
    with Pictures(case.device, [np.zeros_like(picture) for picture in case.pictures]) as others:
        ways = [
            (case.scene.sh, case.targets, options, case.solve(options)),
            (dimmed.sh, others, few, refit_colours(case.device, dimmed, case.cameras, others, few)),
        ]
        for order in (ways * 2, ways[::-1]):
            with ColourRefit(case.device, scene, case.cameras) as refit:
                for sh, targets, how, alone in order:
                    solved = refit.solve(sh, targets, how)
                    assert np.array_equal(solved.sh, alone.sh)
                    assert solved.errors == alone.errors


def test_the_target_itself_is_left_alone(device):
    scene = visible_scene(40)
    with Case(device, scene, scene, ring_of_cameras(3, size=40)) as case:
        refitted = case.solve(RefitOptions())
    assert refitted.errors[1] <= refitted.errors[0] < 1e-12
    assert np.allclose(refitted.sh, scene.sh, atol=1e-4)


def test_active_coefficients_are_those_that_the_quantiser_keeps():
    sh = to_rgb(np.array([[[0.0, 0, 0], [0.3, 0.012, -0.2], [0.009, 0.011, 0], [0, 0, 0]]])).astype(np.float32)
    active = active_coefficients(sh, 50.0)
    assert active[0].tolist() == [[True] * 3, [True, True, True], [False, True, False], [False] * 3]


@pytest.mark.parametrize("degree", [1, 3])
def test_selection_keeps_what_costs_more(device, degree):
    scene = visible_scene(50, degree, seed=degree)
    cameras = [tilted_camera(seed, 48, 48) for seed in range(24)]
    with Case(device, scene, visible_scene(60, 2, 7), cameras) as case:
        options = RefitOptions(steps=0, selection_steps=0, prior=1.0, drop=1e-8)
        active = np.random.default_rng(0).random(scene.sh.shape) < 0.9
        active[:, 0] = True
        with Linearised(case) as linear:
            blocks = linear.blocks
        with ColourRefit(device, scene, cameras) as refit:
            sh = refit.solve(scene.sh, case.targets, options, active).sh
            kept = refit.active()
    x = to_ycocg(sh)
    start = to_ycocg(scene.sh) * active
    least = options.drop * 3 * REFERENCE_PIXELS * len(cameras)
    clear = 0
    for k in range(len(scene)):
        for c, length in enumerate(LENGTHS):
            wanted, values, margin = selection(blocks[k], start[k, :, c], active[k, :, c], length, options.prior, least)
            if margin < 1e-2:
                continue
            clear += 1
            assert kept[k, :, c].tolist() == wanted.tolist()
            assert np.allclose(x[k, :, c], values, atol=2e-3 * np.abs(start[k, :, c]).max())
    assert clear > 0.7 * 3 * len(scene)
    assert 0.1 < kept[:, 1:].sum() / active[:, 1:].sum() < 0.9
    assert not (kept & ~active).any()
    assert np.abs(x[~kept]).max() < 1e-6


@pytest.mark.one_runtime
def test_a_greater_price_keeps_fewer(case):
    kept = []
    for drop in (1e-9, 1e-7, 1e-5, 1e3):
        refitted = case.solve(RefitOptions(drop=drop))
        kept.append(int((np.abs(to_ycocg(refitted.sh)[:, 1:]) > 1e-6).sum()))
        assert np.isfinite(refitted.sh).all()
    assert kept == sorted(kept, reverse=True)
    assert kept[0] > kept[-1] == 0


@pytest.mark.one_runtime
def test_no_view_is_an_error(device):
    with pytest.raises(UsageError, match="at least one view"):
        ColourRefit(device, visible_scene(3), [])


@pytest.mark.one_runtime
def test_views_that_are_not_kept_share_their_memory(case):
    """Drivers take long to give memory back: a product with views that are prepared anew takes none after the first."""
    direction = np.random.default_rng(0).normal(size=case.scene.sh.shape)
    with Linearised(case, memory=0) as linear:
        first = linear.normal(direction)
        with taken_of(case.device) as taken:
            again = linear.normal(direction)
    assert np.array_equal(first, again)
    assert {what for what, _ in taken} <= {"SH coefficients"}, "the vectors of this test"


def test_nobody_waits_for_a_device_that_others_read_from(case, monkeypatch):
    """While one thread waits in a driver, others may get nothing from that device: they would begin late."""
    waited, download = [], case.device.download

    class Others:
        """Do no view, but count as busy between the beginning and the end of a product."""

        busy = False

        def begin_gradient(self, x, blocks, constant, every):
            self.busy = True

        def add(self, sums, blocks):
            self.busy = False
            return {}

    def noted(*args):
        waited.append(others.busy)
        return download(*args)

    others = Others()
    with ColourRefit(case.device, case.scene, case.cameras) as refit:
        vectors = refit.coefficients
        x, result = vectors.vector(), vectors.vector()
        vectors.write_sh(x, case.scene.sh)
        vectors.zero(result)
        monkeypatch.setattr(case.device, "download", noted)
        error = ColourMap(vectors, refit.colour_map.own, others).gradient(x, case.targets, result)
    with Linearised(case) as linear:
        assert error == linear.error
    assert waited
    assert not any(waited)


def test_a_scene_that_never_comes(case):
    """What making it raised is told, and the device's memory is given back."""
    before = case.device.allocated

    def make() -> Scene:
        raise DataError("a splat is too far away")

    with pytest.raises(DataError, match="too far away"):
        ColourRefit(case.device, ComingScene(case.scene.sh, make), case.cameras)
    assert case.device.allocated == before
