"""Octree: splat centres as leaves of an octree (paper section "Codec"; docs/format.md, "Positions").

A leaf is split while it holds several splats or while its centre is too far from its splat. Two parts are stored:

* The *tree* down to the level at which every splat is alone, breadth first: an occupancy byte for each node that holds
  several splats, and a bit for each child that says whether the child holds several too. Level by level it decodes in
  a few vectorised steps, where the paper's depth-first walk is one step a node.
* The *tails*: the path of a lone splat below that level. In an occupancy byte such a path costs more than the three
  bits a level that it is worth, so tails are stored as plain bit planes, coarsest level first.

Splats that even the deepest level cannot separate share a leaf that carries a multiplicity. The order of all
attribute streams is the depth-first (Morton) order of the leaves.

:func:`build` and :func:`parse` are the two directions, :class:`OctreeStreams` is what stands between them.
"""

from potr_cl.codec.octree.builder import Begun, begin, build, leaf_order
from potr_cl.codec.octree.parser import DEEPEST_LEVEL, OctreeStreams, parse

__all__ = ["DEEPEST_LEVEL", "Begun", "OctreeStreams", "begin", "build", "leaf_order", "parse"]
