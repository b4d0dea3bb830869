"""What the stage "fit" computes with. Begin with fit.py.

- fit.py brings a scene's pictures near to targets, round by round, and keeps the best round. The other files are its
  parts:
- derivatives.py goes from numbers for pixels back to the splats' parameters; sweep.py runs it on a device;
- adam.py takes steps down such a gradient;
- together.py takes such steps with one device or several;
- views.py says which views are looked at in which order, and which are held out.
"""
