"""Makes what tests and benchmarks need: excerpts, golden files, large scenes."""
