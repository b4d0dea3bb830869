"""Points along Hilbert's curve."""

import numpy as np

from potr_cl.clustering.curve import along_curve


def test_it_goes_from_each_point_of_a_grid_to_the_next():
    side = 8
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.uint16)
    order = along_curve(grid)
    assert np.array_equal(np.sort(order), np.arange(side**3))
    assert (np.abs(np.diff(grid[order].astype(int), axis=0)).sum(axis=1) == 1).all()


def test_all_bits_count_and_equal_points_keep_their_order():
    grid = np.array([[65535, 0, 0], [0, 0, 0], [65535, 0, 1], [0, 0, 0], [0, 0, 1]], np.uint16)
    assert along_curve(grid)[:2].tolist() == [1, 3]
    assert along_curve(grid)[2] == 4
