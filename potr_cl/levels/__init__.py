"""Levels of detail: one scene encoded again and again, with half as many splats each time (:mod:`.encoding`).

Each level is pruned, fitted and re-fitted against the full scene, in views of the resolution at which it is shown.
"""
