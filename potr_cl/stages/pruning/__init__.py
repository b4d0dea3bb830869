"""What the stage "prune" computes with: removal effects, and who decides by them what goes.

removal.py measures (its docstring names its parts); schedule.py decides, in numpy; on_device.py decides where a GPU
holds the effects.
"""
