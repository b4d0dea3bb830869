"""The viewer in the browser: what a scene looks like, beside another one, and what quality would cost.

:class:`potr_cl.viewer.server.Viewer` is the whole of it. The browser draws by the viewer of pages
(web/src/page); pictures are those of the rasterizer (potr_cl/raster), exact, for comparing and for browsers that cannot
draw. The page, its camera controls and its panel are viser's (the extra ``view``). One module an idea:

- ``session``: the scenes that are looked at, on a device; ``losses``: what each view has lost;
- ``pose``: the browser's camera as ours, and back; ``comparison``: two pictures in one; ``pace``: how many pixels;
- ``visitor``: one tab of a browser, and what it asks for; ``painter``: the thread that makes all pictures;
- ``server``: the page; ``panel``: what stands beside the picture; ``flight``: to a view; ``frusta``: the cameras;
- ``access``: who may connect; ``channel``: what the page says beyond viser; ``uploads``: files that are dropped;
- ``notebook``: the page within a notebook, or a still.
"""
