"""The scenes of the package's tests."""

from tests.conftest import data, judged_once, lego, plush, plush_excerpt, plush_excerpt_cameras

__all__ = ["data", "judged_once", "lego", "plush", "plush_excerpt", "plush_excerpt_cameras"]
