"""The fit of all parameters: what moves, what stays, and which round is kept."""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import CancelledError

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import UsageError
from potr_cl.model.views_between import views_between
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.adam import Adam
from potr_cl.stages.fitting.fit import (
    FitOptions,
    Following,
    Judges,
    Sight,
    _best_pace,
    batches,
    fit_scene,
    held_out_error,
)
from potr_cl.stages.fitting.fitted import File, Fitted, LeftOut, TwoFiles
from potr_cl.stages.fitting.photographs import times
from potr_cl.stages.held_out import share_out
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Results, State, Workbench
from potr_cl.views.targets import RenderedTargets
from tests.cases.judging import mean_error
from tests.cases.surfaces import sphere
from tests.reference.refit_cases import Pictures
from tests.reference.scenes import ring_of_cameras, visible_scene

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
STEPS = FitOptions(steps=200, rounds=5)


def shaken(scene, seed=0, only=PARAMETERS):
    """The scene with errors in some kinds of parameters."""
    rng = np.random.default_rng(seed)
    of_sh = np.where(np.arange(scene.sh.shape[1]) == 0, 0.1, 0.01)[:, None]
    sizes = {"means": 0.01, "log_scales": 0.1, "quaternions": 0.1, "opacity_logits": 0.3, "sh": of_sh}
    changes = {}
    for name in only:
        array = getattr(scene, name)
        changes[name] = (array + rng.normal(scale=sizes[name], size=array.shape)).astype(np.float32)
    return dataclasses.replace(scene, **changes)


def fitted_to(device, source, scene, cameras, options=STEPS, **following):
    with Rasterizer(device, source) as rasterizer:
        return fit_scene(
            device, scene, Sight(cameras, RenderedTargets(rasterizer, cameras)), options, Following(**following)
        )


def test_views_that_judge_find_the_mean_squared_error(device):
    """Of views of several sizes, each counting the same; also of colours beyond 1."""
    source = visible_scene(60, 2, seed=3)
    scene = shaken(source)
    bright = dataclasses.replace(source, sh=5 * source.sh)
    cameras = [*ring_of_cameras(3, size=48), *ring_of_cameras(3, size=131)]
    for targets in (source, bright):
        with Rasterizer(device, targets) as rasterizer:
            found = held_out_error(device, scene, Sight(cameras, RenderedTargets(rasterizer, cameras)))
        _, held_out = share_out(len(cameras), 0)
        assert found == pytest.approx(mean_error(device, targets, scene, [cameras[k] for k in held_out]), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("only", "antialiased"),
    [
        *(pytest.param((name,), False, marks=pytest.mark.one_family, id=name) for name in PARAMETERS),
        pytest.param(PARAMETERS, True, id="all, antialiased"),
    ],
)
def test_errors_of_every_kind_are_mended(device, only, antialiased):
    """On views that the fit has not seen, too."""
    source = dataclasses.replace(visible_scene(60, 2, seed=3), antialiased=antialiased)
    cameras = ring_of_cameras(16, size=48)
    start = shaken(source, only=only)
    result = fitted_to(device, source, start, cameras[::2])
    assert result.scene.antialiased == antialiased
    assert result.errors[-1] < 0.3 * result.errors[0]
    after, before = (mean_error(device, source, scene, cameras[1::2]) for scene in (result.scene, start))
    assert after < 0.5 * before


SOURCE, CAMERAS = visible_scene(60, 1, seed=3), ring_of_cameras(8, size=40)


@pytest.mark.one_family
def test_the_errors_are_those_of_the_views_held_out(family_device):
    """With views of several sizes."""
    cameras = [*ring_of_cameras(9, size=40)[::2], *ring_of_cameras(9, size=72)[1::2]]
    start = shaken(SOURCE)
    result = fitted_to(family_device, SOURCE, start, cameras)
    _, held_out = share_out(len(cameras), 0)
    judges = [cameras[number] for number in held_out]
    assert result.held_out == len(judges) > 0
    assert result.errors[0] == pytest.approx(mean_error(family_device, SOURCE, start, judges), rel=1e-5)
    assert min(result.errors) == pytest.approx(mean_error(family_device, SOURCE, result.scene, judges), rel=1e-4)
    assert result.errors[-1] < 0.3 * result.errors[0]


@pytest.mark.one_family
def test_splats_that_no_view_sees_stay_as_they_are(family_device):
    source = visible_scene(60, 1, seed=3)
    source.quaternions[:] *= 3  # of no unit length
    start = shaken(source)
    start.means[:5] = (0, 0, 1e4)  # above all cameras, which look at the origin
    start.opacity_logits[5] = -9
    result = fitted_to(family_device, source, start, ring_of_cameras(8, size=40))
    assert result.kept > 0
    for name in PARAMETERS:
        before, after = getattr(start, name), getattr(result.scene, name)
        assert np.array_equal(before[:6], after[:6]), name
        assert not np.array_equal(before[6:], after[6:]), name


@pytest.mark.one_family
def test_the_same_bits_every_time_and_others_from_another_seed(family_device):
    results = [
        fitted_to(family_device, SOURCE, shaken(SOURCE), CAMERAS, dataclasses.replace(STEPS, steps=10, seed=seed))
        for seed in (0, 0, 1)
    ]
    for name in PARAMETERS:
        first, second, third = (getattr(result.scene, name) for result in results)
        assert np.array_equal(first, second)
        assert not np.array_equal(first, third)


@pytest.mark.one_family
def test_what_does_not_help_is_not_kept(family_device):
    """A scene that is perfect in the views held out, and targets elsewhere that lead away from it."""
    _, held_out = share_out(8, 0)
    with Rasterizer(family_device, SOURCE) as rasterizer:
        pictures = [rasterizer.render(camera)[0] for camera in CAMERAS]
    wrong = [picture if number in held_out else 1 - picture for number, picture in enumerate(pictures)]
    start = shaken(SOURCE, only=("sh",))
    with Pictures(family_device, wrong) as targets:
        result = fit_scene(family_device, start, Sight(CAMERAS, targets), STEPS)
    assert result.kept == 0
    assert result.steps < STEPS.steps, "the fit should end before"
    for name in PARAMETERS:
        assert np.array_equal(getattr(result.scene, name), getattr(start, name))


def test_no_splat_leaves_the_range_of_sizes_and_opacities(family_device):
    start = shaken(SOURCE)
    with Pictures(family_device, [np.zeros((40, 40, 3), np.float32)] * 8) as targets:
        rates = dataclasses.replace(STEPS.rates, log_scales=1.0, opacity_logits=5.0)
        options = FitOptions(steps=40, rates=rates, patience=10)
        result = fit_scene(family_device, start, Sight(CAMERAS, targets), options)
    assert result.kept > 0
    assert result.scene.log_scales.min() >= start.log_scales.min()
    assert result.scene.log_scales.max() <= start.log_scales.max()
    changed = result.scene.opacity_logits != start.opacity_logits
    assert result.scene.opacity_logits[changed].min() >= -5.5


@pytest.mark.one_family
def test_targets_need_not_all_be_kept(family_device):
    found = []
    for memory in (None, 0, 2 * 12 * 40 * 40):
        few = dataclasses.replace(STEPS, steps=20, memory=memory)
        found.append(fitted_to(family_device, SOURCE, shaken(SOURCE), CAMERAS, few).errors)
    assert found[0] == found[1] == found[2]


def test_added_views_are_never_held_out():
    for given in range(2, 40):
        for added in (0, 5):
            fit_to, held_out = share_out(given, added)
            assert sorted(fit_to + held_out) == list(range(given + added))
            assert 0 < len(held_out) <= min(8, given - 1)
            assert max(held_out) < given
    assert share_out(1, 3) == ([0, 1, 2, 3], [])


def test_every_view_comes_as_often_as_any_other():
    order = batches(range(3, 10), 4, seed=0)
    taken = np.concatenate([next(order) for _ in range(7)])
    assert np.array_equal(np.bincount(taken)[3:], [4] * 7)
    assert next(batches([5], 4, seed=0)) == [5]


@pytest.mark.parametrize(
    ("after", "pace", "tried"),
    [
        ({1: 8, 2: 7, 4: 6, 8: 5}, 8, [1, 2, 4, 8]),
        ({1: 8, 2: 7, 4: 8}, 2, [1, 2, 4]),
        ({1: 8, 2: 9, 0.5: 7}, 1, [1, 2]),  # shorter steps help more at first only
        ({1: 11, 0.5: 9.9}, 0.5, [1, 0.5]),
        ({1: 12, 0.5: 10.5, 0.25: 9}, 0.25, [1, 0.5, 0.25]),
        ({1: 14, 0.5: 13, 0.25: 12, 0.125: 11, 0.0625: 10.5}, 0.0625, [1, 0.5, 0.25, 0.125, 0.0625]),
        ({1: 8, 2: math.nan}, 1, [1, 2]),
        ({1: math.nan, 0.5: 11, 0.25: 9}, 0.25, [1, 0.5, 0.25]),
    ],
)
def test_the_longest_steps_that_help_are_taken(after, pace, tried):
    asked = []

    def run(options, following):
        asked.append(options.pace)
        return Fitted(SOURCE, options.steps, 0, (10.0, after[options.pace]), 1)

    assert _best_pace(STEPS, run, Following()) == pace
    assert asked == tried


def test_a_pace_is_no_good_where_someone_asks_to_end_meanwhile():
    def run(options, following):
        return Fitted(SOURCE, 0, 0, (10.0, 9.0 if options.pace == 1 else 8.0), 1, options.pace > 1)

    assert _best_pace(STEPS, run, Following()) == 1


def test_a_trial_says_that_it_goes_on():
    told = []

    def run(options, following):
        following.progress(1, options.steps)
        return Fitted(SOURCE, 0, 0, (10.0, 9.0 if options.pace == 1 else 9.5), 1)

    _best_pace(STEPS, run, Following(lambda *done: told.append(done)))
    assert told == [(0, STEPS.steps)] * 2


def test_few_steps_are_as_long_as_usual():
    assert _best_pace(FitOptions(steps=100), None, Following()) == 1


def test_steps_that_do_harm_become_shorter(family_device):
    options = dataclasses.replace(STEPS, rates=times(STEPS.rates, 30.0))
    scene, cameras = shaken(SOURCE), CAMERAS[:4]
    harmed = fitted_to(family_device, SOURCE, scene, cameras, options)
    found = fitted_to(family_device, SOURCE, scene, cameras, dataclasses.replace(options, pace=None))
    assert found.pace < 1
    assert found.error < 0.5 * harmed.error
    again = fitted_to(family_device, SOURCE, scene, cameras, dataclasses.replace(options, pace=found.pace))
    assert again.errors == found.errors  # of what was tried nothing is left
    assert all(np.array_equal(getattr(again.scene, name), getattr(found.scene, name)) for name in PARAMETERS)


def test_rates_are_halved_where_held_out_views_become_worse(family_device, monkeypatch):
    parts, step = [], Adam.step

    def noted(self, gradient, part):
        parts.append(part)
        step(self, gradient, part)

    monkeypatch.setattr(Adam, "step", noted)
    errors = iter([0.10, 0.14, 0.12, 0.13, 0.11])
    monkeypatch.setattr(Judges, "error", lambda self: next(errors))
    options = FitOptions(steps=50, rounds=5, patience=4, last=1.0)
    fitted_to(family_device, SOURCE, SOURCE, CAMERAS, options)
    # Not after the first round, nor after the second, which gains; the fit ends after four that are not the best.
    assert parts == [parts[0]] * 30 + [parts[0] / 2] * 10


def test_progress_and_what_is_told(family_device):
    told, lines = [], []
    options = FitOptions(steps=6, rounds=3)
    progress = {"progress": lambda done, steps: told.append((done, steps)), "tell": lines.append}
    fitted_to(family_device, SOURCE, shaken(SOURCE), CAMERAS[:4], options, **progress)
    assert told == [(done, 6) for done in range(1, 7)]
    assert len(lines) == 3
    assert all("held-out" in line for line in lines)


# ------------------------------------------------------------------------------------------ the stage


def bench_of(device):
    return Workbench(HyperParameters.from_quality(0.5, "best"), device=device)


@pytest.mark.one_family
def test_the_stage_mends_what_pruning_has_left(family_device):
    source = visible_scene(120, 1, seed=3)
    left = np.arange(0, 120, 2)
    cameras = ring_of_cameras(8, size=48)
    before = State.of(source, cameras).keeping(left)
    after = Fit(steps=200, choosing=0, rounding=0).run(before, bench_of(family_device))
    assert np.array_equal(after.survivors, left)
    assert after.geometry is None
    assert isinstance(after.results.fitted, Fitted)
    errors = [mean_error(family_device, source, state.scene, cameras) for state in (before, after)]
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.one_family
def test_one_view_cannot_be_held_out(family_device):
    before = State.of(SOURCE, CAMERAS[:1])
    after = Fit(steps=10).run(before, bench_of(family_device))
    assert after.scene is before.scene
    assert isinstance(after.results.fitted, LeftOut)
    assert "two training views" in str(after.results.fitted)
    with pytest.raises(UsageError, match="two training views"):
        fitted_to(family_device, SOURCE, SOURCE, CAMERAS[:1])


@pytest.mark.one_family
def test_sparse_colours_stay_sparse(family_device):
    source = visible_scene(60, 2, seed=3)
    start = shaken(source)
    start.sh[:, 4:] = 0
    before = dataclasses.replace(
        State.of(source, ring_of_cameras(8, size=40)), scene=start, results=Results(compacted=True)
    )
    after = Fit(steps=30).run(before, bench_of(family_device)).scene
    assert np.array_equal(after.sh[:, 1:], start.sh[:, 1:])
    assert not np.array_equal(after.sh[:, 0], start.sh[:, 0])


# ------------------------------------------------------------------------------------------ fewer splats for the fit


def priced(source, cameras, price):
    """As pruning has left it that removed nothing."""
    return State.of(source, cameras).with_results(price=price)


def cost(device, source, scene, cameras, price):
    _, held_out = share_out(len(cameras), 0)
    return mean_error(device, source, scene, [cameras[n] for n in held_out]) + 1.25 * price * len(scene)


#: Of which about half of the excerpt's splats are worth it.
PRICE = 3e-8


@pytest.mark.one_family
def test_splats_are_removed_for_the_fit_to_make_up_for(family_device, plush_excerpt, small_views):
    before = priced(plush_excerpt, small_views, PRICE)
    after = priced_fit(2).run(before, bench_of(family_device))
    told = after.results.fitted
    assert isinstance(told, Fitted)
    assert told.spared == len(before.scene) - len(after.scene) > 300
    assert len(after.survivors) == len(after.scene)
    costs = [cost(family_device, plush_excerpt, state.scene, small_views, PRICE) for state in (before, after)]
    assert costs[1] < 0.9 * costs[0]
    assert told.without + 1.25 * PRICE * len(before.scene) == pytest.approx(costs[0], rel=1e-3)
    assert told.error + 1.25 * PRICE * len(after.scene) == pytest.approx(costs[1], rel=1e-3)
    assert f"{told.spared:,} splats more" in str(told)
    assert after.results.price == PRICE


def priced_fit(further, **options):
    """A fit that removes splats up to so many times the price."""
    at_price = further / math.sqrt(PRICE / 10**-9.3)
    fit = Fit(**{"steps": 50, "further": at_price, "between": 0, "choosing": 0, "rounding": 0, **options})
    assert fit.limit(PRICE) == pytest.approx(further * PRICE)
    return fit


@pytest.mark.one_family
def test_little_is_left_to_the_refit(family_device, plush_excerpt, small_views):
    """Splats that moved have fewer coefficients that are 0: a fit that gains little makes a larger file."""
    start = shaken(plush_excerpt, only=("sh",))
    before = dataclasses.replace(State.of(plush_excerpt, small_views), scene=start)
    after = Fit(steps=2, between=0).run(before, bench_of(family_device))
    with Rasterizer(family_device, plush_excerpt) as rasterizer:
        alone = fit_scene(
            family_device, start, Sight(small_views, RenderedTargets(rasterizer, small_views)), FitOptions(steps=2)
        )
    assert 0.7 * alone.errors[0] < alone.error < alone.errors[0], "the fit gains, but little"
    assert isinstance(after.results.fitted, LeftOut)
    assert "gained little" in str(after.results.fitted)
    assert after.scene is before.scene


def test_the_threshold_grows_faster_than_what_it_follows():
    limits = [Fit().limit(price) / price for price in (1e-12, 1e-10, 1e-9, 1e-8, 1e-3)]
    assert limits == sorted(limits)
    assert limits[0] == 1
    assert limits[-1] == 20
    assert [Fit(further=0).limit(price) for price in (1e-9, 1e-3)] == [1e-9, 1e-3]


@pytest.mark.one_family
def test_the_best_of_all_cycles_is_kept(family_device, plush_excerpt, small_views):
    """The last one, from too few splats, is not."""
    start, further = priced(plush_excerpt, small_views, PRICE), 12
    bench = bench_of(family_device)
    after = priced_fit(further, cycles=3, steps=60).run(start, bench)
    costs = [cost(family_device, plush_excerpt, state.scene, small_views, PRICE) for state in (start, after)]
    assert costs[1] < 0.97 * costs[0]
    low = dataclasses.replace(bench.parameters, delta_mse_max=further * PRICE)
    fewest = Prune(iterations=16).run(start, dataclasses.replace(bench, parameters=low))
    assert len(after.scene) > 1.2 * len(fewest.scene)


@pytest.mark.one_family
def test_views_between_are_its_own(family_device, plush_excerpt, small_views):
    fits = [priced_fit(2, between=between, steps=20) for between in (0, 2)]
    states = [fit.run(priced(plush_excerpt, small_views, PRICE), bench_of(family_device)) for fit in fits]
    for state in states:
        assert state.views == tuple(small_views)
        assert state.added == 0
    assert not np.array_equal(states[0].scene.means, states[1].scene.means)


@pytest.mark.one_family
def test_views_between_are_added_to_the_given_ones(family_device):
    """In place of fewer that a stage has added before, and not where there are as many already."""
    source, given = sphere(1000, 1.0, 0.05), tuple(ring_of_cameras(6, size=40))
    one = tuple(views_between(source, given, 1))
    before = dataclasses.replace(State.of(source, (*given, *one)), added=len(one))
    after = Fit(between=2)._looking_between(before, bench_of(family_device))
    two = tuple(views_between(source, given, 2))
    assert [view.name for view in after.views] == [view.name for view in (*given, *two)]
    assert after.added == len(two) > len(one) == 6
    assert Fit(between=1)._looking_between(before, bench_of(family_device)) is before


@pytest.mark.one_family
@pytest.mark.parametrize(("steps", "further", "price"), [(2, 1e6, 1e-9), (2, 1e4, 1e-7)])
def test_what_does_not_pay_is_left_out(family_device, steps, further, price):
    before = priced(SOURCE, CAMERAS, price)
    after = Fit(steps=steps, further=further).run(before, bench_of(family_device))
    assert isinstance(after.results.fitted, LeftOut)
    assert "did not make up" in str(after.results.fitted)
    assert after.scene is before.scene
    assert after.survivors is before.survivors


def test_steps_are_finer_the_more_splats_are_left():
    """By a fifth of the way to 1 for a usual quality, by little for a low one; a higher quality stays a higher one."""
    shares = [(Fit().quality(q) - q) / (1 - q) for q in (0.0, 0.2, 0.3, 0.5, 0.9)]
    assert np.diff(shares).min() > -1e-9
    assert shares[0] == 0
    assert shares[2] < 0.5 * shares[3]
    assert shares[3:] == pytest.approx([0.18, 0.18])
    qualities = [Fit().quality(q) for q in np.linspace(0, 1, 101)]
    assert (np.diff(qualities) > 0).all()
    assert Fit(finer=0).quality(0.4) == 0.4


def test_automatic_steps_and_what_they_are_on_each_family():
    assert Fit(steps="auto").asked_for
    assert 0 < Fit(steps="auto").steps_on("cpu") < Fit(steps="auto").steps_on("gpu")
    assert Fit(steps=7).steps_on("cpu") == 7
    assert Fit(steps=5).asked_for
    assert not Fit().asked_for


# ---------------------------------------------------------------------------------------- which of two files is better


def two(nbytes: float, decibels: float) -> TwoFiles:
    """A file of 100,000 bytes and 50 dB, and one with a fit: by how much its size and PSNR differ."""
    return TwoFiles(File(100_000, 1e-5), File(round(100_000 * nbytes), 1e-5 * 10 ** (-decibels / 10)))


@pytest.mark.parametrize(
    ("nbytes", "decibels", "pays"),
    [
        (0.85, 0.0, True),
        (1.0, 1.0, True),
        (0.9, -0.5, True),  # at 15 % a decibel, half of it would take back 7 %
        (0.9, -1.0, False),
        (1.04, 1.2, True),
        (1.04, 0.6, False),  # at 5 % a decibel it would be larger
        (1.0, 0.0, False),
        (0.995, 0.0, False),  # so little may be chance
        (1.0, 0.1, False),
        (1.002, -0.16, False),
    ],
)
def test_it_pays_however_much_a_decibel_takes(nbytes, decibels, pays):
    assert two(nbytes, decibels).pays is pays


def test_what_is_told_of_both():
    files = two(0.9, -0.5)
    assert files.facts["without"] == {"bytes": 100_000, "psnr": pytest.approx(50)}
    assert files.facts["with"] == {"bytes": 90_000, "psnr": pytest.approx(49.5)}
    assert "90,000 bytes and 49.50 dB with it, 100,000 bytes and 50.00 dB without" in str(files)


@pytest.mark.parametrize("keeps", [True, False])
@pytest.mark.parametrize("together", [1 << 24, 1])
def test_judges_see_the_same_every_time(device, together, keeps, monkeypatch):
    """All in one go or one after the other, of several sizes, as often as they are asked; nothing is left behind."""
    monkeypatch.setattr("potr_cl.stages.fitting.fit._RENDERED", together)
    source = visible_scene(60, 2, seed=3)
    cameras = [*ring_of_cameras(3, size=48), *ring_of_cameras(2, size=131)]
    every = range(len(cameras))
    scene = shaken(source)
    with Rasterizer(device, source) as rasterizer, Rasterizer(device, scene) as own:
        sight = Sight(cameras, RenderedTargets(rasterizer, cameras))
        with sight.pictures(device, None) as pictures:
            pictures.fill([(number,) for number in every])
            before = device.allocated
            with Judges(device, own, cameras, pictures, every, keeps) as judges:
                errors = {judges.error() for _ in range(3)}
            own.rest()
            assert device.allocated == before
    assert len(errors) == 1
    assert errors.pop() == pytest.approx(mean_error(device, source, scene, cameras), rel=1e-5)


@pytest.mark.one_family
def test_views_between_are_those_that_were_sought_meanwhile(device, plush_excerpt, plush_excerpt_cameras):
    state, bench, own = State.of(plush_excerpt, plush_excerpt_cameras), bench_of(device), len(plush_excerpt_cameras)
    begun = Fit(steps=10, between=2.0).begun(state, bench)
    assert begun.results.sought is not None
    sought = begun.results.sought.views.result()
    # Those themselves; for another number of them others are looked for.
    seen = Fit(steps=10, between=2.0)._looking_between(begun, bench).views
    assert list(map(id, seen[own:])) == list(map(id, sought))
    fewer = Fit(steps=10, between=1.0)._looking_between(begun, bench).views
    assert 0 < len(fewer) - own < len(sought)
    alone = Fit(steps=10, between=2.0)._looking_between(state, bench).views
    assert [(v.name, v.translation.tolist()) for v in alone] == [(v.name, v.translation.tolist()) for v in seen]


@pytest.mark.one_family
def test_nobody_looks_on_after_a_stop(device, plush_excerpt, plush_excerpt_cameras):
    begun = Fit(steps=10, between=100).begun(State.of(plush_excerpt, plush_excerpt_cameras), bench_of(device))
    sought = begun.results.sought
    assert sought is not None
    sought.stop()
    with pytest.raises(CancelledError):
        sought.views.result(timeout=60)


@pytest.mark.one_family
def test_nothing_is_sought_where_no_views_are_added(device, plush_excerpt, plush_excerpt_cameras):
    bench = bench_of(device)
    one = State.of(plush_excerpt, plush_excerpt_cameras[:1])
    enough = dataclasses.replace(State.of(plush_excerpt, plush_excerpt_cameras), added=len(plush_excerpt_cameras) // 2)
    for state in (one, enough):
        assert Fit(steps=10, between=1.0).begun(state, bench) is state
