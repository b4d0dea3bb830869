"""Files of blocks, version 4 of the format: a table of blocks, and the blocks, each a whole file of its own.

Scenes of many millions of splats are cut into blocks of neighbours (:mod:`.splitting`), each quantised in an octree of
its own (:mod:`.geometry`) and coded by itself (:mod:`.encoder`), so that neither coding nor decoding takes memory for
more than the blocks that are worked on, and a part of a scene is read without the rest (:mod:`.file`). :mod:`.table` is
the container.
"""
