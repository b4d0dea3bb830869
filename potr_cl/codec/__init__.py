"""From a scene to the bytes of a .potr file and back: quantiser, octree, entropy coders, container. No views, no
device.
"""
