"""The scenes of the package's tests."""

from tests.conftest import computed_once, data, lego, plush, plush_excerpt, plush_excerpt_cameras

__all__ = ["computed_once", "data", "lego", "plush", "plush_excerpt", "plush_excerpt_cameras"]
