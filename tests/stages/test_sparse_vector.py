"""Vectors of coefficients arrive as they were, to the last bit, and what is 0 does not travel."""

from __future__ import annotations

import dataclasses
import itertools
from contextlib import ExitStack

import numpy as np
import pytest

from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.exchange import Exchange, SparseVector
from potr_cl.stages.refitting.sliced_arrays import Layout
from tests.devices import KERNELS, open_device


@pytest.mark.parametrize("kernels", KERNELS)
def test_vectors_arrive_as_they_were(kernels):
    device, splats = open_device(kernels), 201
    for sh_count, part in itertools.product([1, 4, 16], [0.0, 0.1, 1.0]):
        rng = np.random.default_rng(sh_count)
        columns = rng.standard_normal((3 * sh_count, splats)).astype(np.float32)
        columns[rng.random(columns.shape) >= part] = 0
        columns[0, :4] = [-0.0, np.nan, np.inf, 1e-42]
        layout = Layout(splats, stride_of(splats), sh_count, 1)
        with ExitStack() as stack:
            here, there = (stack.enter_context(Coefficients(device, layout)) for _ in range(2))
            x, y = here.vector(), there.vector()
            for coefficients, vector in ((here, x), (there, y)):
                coefficients.zero(vector)
            here.write(x, columns)
            there.write(y, np.full_like(columns, 7))
            taking, giving = (stack.enter_context(Exchange(each)) for each in (here, there))
            sent = taking.send_vector(x)
            if part < 1:
                assert isinstance(sent, SparseVector)
                assert sent.nbytes == 8 * splats + 4 * np.count_nonzero(columns.view(np.uint32))
            assert sent.nbytes <= columns.nbytes
            giving.take_vector(y, sent)
            found = device.download(y, (layout.columns, layout.stride), np.float32)
            assert np.array_equal(found[:, :splats].view(np.uint32), columns.view(np.uint32))
            if isinstance(sent, SparseVector):
                with pytest.raises(ValueError, match="coefficients, where there should be"):
                    giving.take_vector(y, dataclasses.replace(sent, values=sent.values[1:]))
        assert device.allocated == 0
