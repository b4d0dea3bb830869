"""What memory of the device a fit takes (:func:`fit_bytes`)."""

from __future__ import annotations

#: Buffers of all parameters: the rasterizer's, the gradient, the parameters, the best ones, averages, two moments.
_VECTORS = 7
#: Bytes of a splat in each view of a batch besides the prepared view: its sums, its bounds.
_OF_SPLAT = 72 + 8
#: Bytes of a splat in what a rasterizer keeps to render pictures one by one: its projection, and a list of four
#: intersections with their sort keys.
_FRAME = 144
#: Bytes of a pixel's colour.
_PIXEL = 12


def fit_bytes(
    splats: int, source: int, sh_columns: int, together: int, views: int, view: float, pixels: float, room: float
) -> float:
    """Bytes of the device's memory that a fit takes at its peak, about.

    Args:
        splats: that are fitted. source: of the scene that renders the targets.
        sh_columns: SH coefficients of a splat, all channels.
        together: views that are prepared at a time: a batch on GPUs, one on CPUs.
        views: in all.
        view: bytes of a prepared view.
        pixels: of a view.
        room: bytes that target pictures may take.
    """
    parameters = 4 * (11 + sh_columns)
    prepared = together * (view + splats * _OF_SPLAT)
    pictures = min(views * _PIXEL * pixels, room) + (together + 2) * _PIXEL * pixels
    return splats * (parameters * _VECTORS + _FRAME) + source * (parameters + _FRAME) + prepared + pictures
