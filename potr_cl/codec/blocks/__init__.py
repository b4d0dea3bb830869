"""Scenes in blocks: cut into neighbours (:mod:`.splitting`), each quantised in an octree of its own (:mod:`.geometry`).

So neither coding nor decoding takes memory for more than the blocks that are worked on, and a part of a scene is read
without the rest.
"""
