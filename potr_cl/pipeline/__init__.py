"""A whole encode: options, presets, the stages in their order, the search for a size or a quality."""
