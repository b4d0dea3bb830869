"""The scenes of the package's tests."""

from tests.conftest import data, computed_once, lego, plush, plush_excerpt, plush_excerpt_cameras

__all__ = ["data", "computed_once", "lego", "plush", "plush_excerpt", "plush_excerpt_cameras"]
