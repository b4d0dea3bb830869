"""The scenes of the package's tests."""

from tests.conftest import data, lego, lego_excerpt, lego_excerpt_cameras, plush

__all__ = ["data", "lego", "lego_excerpt", "lego_excerpt_cameras", "plush"]
