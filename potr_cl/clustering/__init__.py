"""Many numbers or vectors by few: codebooks and palettes. What the vectors mean is the callers' business."""
