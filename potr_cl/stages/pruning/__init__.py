"""What the stage "prune" computes with. Begin with removal.py and schedule.py.

- removal.py measures what the removal of each splat would do to the pictures, on one device. Its docstring names the
  files that are its parts. Which views it looks at with which splats, and which of them stay on the device, is a plan's
  matter (:mod:`potr_cl.views`), which it chooses.
- helpers.py has what other devices or computers measure, which it adds (exchange.py), and opens all of that.
- schedule.py decides from these effects which splats go, in NumPy. controller.py decides the same on a GPU, so that the
  effects need not be fetched.
"""
