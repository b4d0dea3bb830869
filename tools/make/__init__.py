"""Makes what is committed: test data, golden files, and the generated pages of docs/ (docs.py makes them all).

large_scene.py makes scenes that are too large to be committed.
"""
