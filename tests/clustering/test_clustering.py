"""Clusters of vectors on every device, against NumPy; few numbers for many, and points along Hilbert's curve."""

import numpy as np
import pytest

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.comparison import Lists, Points, centres_of_sums, errors_at_zero, rows_of_points
from potr_cl.clustering.curve import along_curve
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


def test_few_numbers_stay_as_they_are():
    values = np.array([3, -1, 3, 0.1, -1], np.float32)
    assert codebook(values, None, 3).tolist() == [-1, np.float32(0.1), 3]


def test_the_error_is_near_that_of_the_best_book():
    values = np.random.default_rng(1).normal(size=20000).astype(np.float32)
    book = codebook(values, None, 256)
    assert len(book) == 256
    error = np.square(values - book[nearest(values, book)], dtype=np.float64).mean()
    # Panter and Dite: the least error of many levels for a normal density is sqrt(3) pi / (2 levels^2).
    assert error < 1.15 * np.sqrt(3) * np.pi / (2 * 256**2)


def test_what_weighs_more_is_nearer():
    values = np.concatenate([np.linspace(0, 1, 5000), np.linspace(10, 11, 5000)]).astype(np.float32)
    weights = np.repeat([1.0, 100.0], 5000)
    book = codebook(values, weights, 32)
    errors = np.abs(values - book[nearest(values, book)])
    assert errors[5000:].max() < 0.5 * errors[:5000].max()


@pytest.mark.parametrize("values", [np.zeros(1000), np.full(1000, 1e30), np.r_[np.zeros(999), 1e37]])
def test_values_without_extent_or_far_apart(values):
    values = values.astype(np.float32)
    book = codebook(values, np.zeros(len(values)), 4)
    assert np.isfinite(book).all()
    assert np.array_equal(book[nearest(values, book)], values)


def test_nearest_is_nearest():
    generator = np.random.default_rng(2)
    book = np.unique(generator.normal(size=50).astype(np.float32))
    values = generator.normal(size=(40, 3)).astype(np.float32)
    found = nearest(values, book)
    assert np.array_equal(found, np.abs(values[..., None].astype(np.float64) - book).argmin(axis=-1))


def test_the_curve_goes_from_each_point_of_a_grid_to_the_next():
    side = 8
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.uint16)
    order = along_curve(grid)
    assert np.array_equal(np.sort(order), np.arange(side**3))
    assert (np.abs(np.diff(grid[order].astype(int), axis=0)).sum(axis=1) == 1).all()


def test_along_the_curve_all_bits_count_and_equal_points_keep_their_order():
    grid = np.array([[65535, 0, 0], [0, 0, 0], [65535, 0, 1], [0, 0, 0], [0, 0, 1]], np.uint16)
    assert along_curve(grid)[:2].tolist() == [1, 3]
    assert along_curve(grid)[2] == 4


def test_the_curve_is_that_of_skillings_transformation():
    """J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707, 2004: bits one after the other."""
    points = np.random.default_rng(3).integers(0, 1 << 16, (500, 3))

    def place(axes: list[int]) -> int:
        for bit in reversed(range(1, 16)):
            below = (1 << bit) - 1
            for number in range(3):
                if axes[number] >> bit & 1:
                    axes[0] ^= below
                else:
                    turned = (axes[0] ^ axes[number]) & below
                    axes[0] ^= turned
                    axes[number] ^= turned
        axes[1] ^= axes[0]
        axes[2] ^= axes[1]
        carried = 0
        for bit in range(1, 16):
            carried ^= (1 << bit) - 1 if axes[2] >> bit & 1 else 0
        axes = [axis ^ carried for axis in axes]
        return sum((axes[number] >> bit & 1) << (3 * bit + 2 - number) for bit in range(16) for number in range(3))

    places = [place(point) for point in points.tolist()]
    assert along_curve(points.astype(np.uint16)).tolist() == sorted(range(len(places)), key=places.__getitem__)
