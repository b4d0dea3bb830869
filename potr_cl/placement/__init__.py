"""Views for scenes that come without cameras: where somebody could stand, near enough to see what there is.

Begin with virtual.py.

- virtual.py places the views that an encoder looks at, and others to judge by;
- candidates.py draws views in free space, and asks colours from where they were trained;
- space.py knows where matter is; rays.py asks a device what is seen from where, and finds the splats that no view has
  resolved: nothing is known of them, so they stay;
- viewpoints.py holds some views level, for people.
"""
