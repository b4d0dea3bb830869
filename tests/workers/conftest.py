"""What tests of shared work share."""

from __future__ import annotations

import pytest

from tests.devices import FAMILIES


@pytest.fixture(scope="module", params=FAMILIES)
def family(request: pytest.FixtureRequest) -> str:
    return request.param
