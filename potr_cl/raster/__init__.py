"""The rasterizer: projection, tile lists, depth order, compositing, and prepared views that are kept."""
