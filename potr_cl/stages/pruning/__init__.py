"""What the stage "prune" computes with. Begin with removal.py and schedule.py.

- removal.py measures what the removal of each splat would do to the pictures. Its docstring names the files that are
  its parts.
- schedule.py decides from these effects which splats go, in NumPy. on_device.py decides the same on a GPU, so that the
  effects need not be fetched.
- view_by_view.py and visible_parts.py measure large scenes, of which no view sees much. measured.py chooses between all
  these.
"""
