"""Clusters of vectors on every device, against NumPy."""

import numpy as np
import pytest

from potr_cl.clustering.comparison import Lists, Points, centres_of_sums, errors_at_zero, rows_of_points
from potr_cl.clustering.kmeans import Rate, assigned, cluster
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    return open_device(request.param)


def some(count, groups, seed=1):
    """Vectors of very different lengths, as SH coefficients are, and weights."""
    generator = np.random.default_rng(seed)
    lengths = np.exp(generator.normal(size=(count, 1, 1)))
    points = lengths * generator.normal(size=(count, groups, 3))
    return points.astype(np.float32), generator.uniform(0.1, 2, (count, groups)).astype(np.float32)


def distances(points, weights, centres):
    """(N, K) in float64."""
    apart = points[:, None].astype(np.float64) - centres[None]
    return np.einsum("nkgc,nkgc,ng->nk", apart, apart, weights.astype(np.float64))


@pytest.mark.parametrize("groups", [3, 15])
def test_the_best_centre_is_found(device, groups):
    points, weights = some(333, groups)
    centres = some(77, groups, seed=2)[0]
    biases = np.random.default_rng(3).uniform(0, 5, 77).astype(np.float32)
    with Points(device, rows_of_points(points, weights)) as at:
        labels, scores = at.nearest(centres, biases)
    expected = distances(points, weights, centres) + biases
    found = expected[np.arange(333), labels]
    assert found == pytest.approx(expected.min(axis=1), rel=1e-4, abs=1e-3)
    assert scores + errors_at_zero(points, weights) == pytest.approx(found, rel=1e-4, abs=1e-3)
    assert device.allocated == 0


def test_points_are_compared_with_the_centres_of_their_cell(device):
    points, weights = some(200, 3)
    centres = some(40, 3, seed=2)[0]
    cells = np.random.default_rng(3).integers(0, 3, 200).astype(np.uint32)
    runs = np.array([[0, 10], [5, 20], [0, 1], [39, 1]], np.uint32)
    allowed = [np.r_[0:10], np.r_[5:25], np.r_[0, 39]]
    with Points(device, rows_of_points(points, weights)) as at:
        labels, _ = at.nearest(centres, None, cells, Lists(runs, np.array([0, 1, 2, 4], np.uint32)))
    expected = distances(points, weights, centres)
    for row, cell in enumerate(cells):
        assert expected[row, labels[row]] == pytest.approx(expected[row, allowed[cell]].min(), rel=1e-4, abs=1e-3)


def test_centres_become_weighted_means(device):
    points, weights = some(500, 8)
    labels = np.random.default_rng(4).integers(0, 6, 500).astype(np.uint32)
    labels[labels == 4] = 5
    before = np.full((6, 8, 3), 7, np.float32)
    with Points(device, rows_of_points(points, weights)) as at:
        centres = centres_of_sums(at.sums(labels, 6), before)
    for number in (0, 1, 2, 3, 5):
        mine = labels == number
        mean = (weights[mine, :, None] * points[mine]).sum(axis=0) / weights[mine].sum(axis=0)[:, None]
        assert centres[number] == pytest.approx(mean, abs=1e-5)
    assert np.array_equal(centres[4], before[4])


@pytest.mark.slow
def test_clusters_are_about_as_good_as_those_of_all_comparisons(device):
    points, weights = some(3000, 3)
    found = cluster(device, points, weights, 600)
    assert found.centres.shape == (600, 3, 3)
    assert len(np.unique(found.labels)) > 550
    error = distances_to_own(points, weights, found.centres, found.labels)
    centres = points[:: len(points) // 600][:600].copy()
    for _ in range(8):  # Lloyd's algorithm, each point with all centres
        labels = distances(points, weights, centres).argmin(axis=1)
        for number in np.unique(labels):
            mine = labels == number
            centres[number] = (weights[mine, :, None] * points[mine]).sum(0) / weights[mine].sum(0)[:, None]
    assert error < 1.1 * distances_to_own(points, weights, centres, labels)
    assert device.allocated == 0


def distances_to_own(points, weights, centres, labels):
    return float((weights[:, :, None] * np.square(points - centres[labels])).sum())


def test_what_labels_and_entries_take_decides_how_many_there_are_with_the_same_bits_every_time(device):
    points, weights = some(2000, 3)
    found = [cluster(device, points, weights * np.float32(30), 600, Rate(bits)) for bits in (1.0, 100.0, 100.0, 1e5)]
    assert not any(each.centres[0].any() for each in found)
    counts = [len(np.unique(each.labels)) for each in found]
    assert counts[0] > counts[1] > counts[3]
    assert counts[1] >= 20
    assert found[1].centres.tobytes() == found[2].centres.tobytes()
    assert np.array_equal(found[1].labels, found[2].labels)


def test_points_that_weigh_nothing_take_the_cheapest_label(device):
    points, weights = some(900, 3)
    weights[:600] = 0
    found = cluster(device, points, weights * np.float32(1000), 600, Rate(50))
    labels, counts = np.unique(found.labels[:600], return_counts=True)
    assert len(labels) == 1
    assert counts[0] == 600


def test_hardly_any_points_and_equal_ones(device):
    for count, most in ((1, 100), (5, 100), (1000, 10)):
        points, weights = some(min(count, 5), 15)
        if count > 5:
            points, weights = np.ones((count, 3, 3), np.float32), np.ones((count, 3), np.float32)
        found = cluster(device, points, weights * np.float32(1e6), most)
        assert found.centres[found.labels] == pytest.approx(points, abs=1e-5)
        assert cluster(device, points, weights * np.float32(1e6), most, Rate(1e-3)).labels.shape == (count,)


def test_the_best_of_given_centres(device):
    points, weights = some(1200, 3)
    centres = points[::2] + np.float32(0.01)
    labels = assigned(device, points, weights, centres)
    expected = distances(points, weights, centres)
    found = expected[np.arange(1200), labels]
    assert np.mean(found <= expected.min(axis=1) + 1e-4) > 0.9
    assert found.mean() < 1.05 * expected.min(axis=1).mean()
