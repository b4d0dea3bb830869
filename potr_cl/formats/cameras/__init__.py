"""Camera files, one module a format."""
