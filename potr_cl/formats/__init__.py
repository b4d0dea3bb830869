"""One module a file format, each with load(path) and, where we write it, save(path, …)."""
