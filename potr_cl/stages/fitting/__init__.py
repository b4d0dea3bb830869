"""What the stage "fit" computes with. Begin with fit.py.

- fit.py brings a scene's pictures near to targets, round by round, and keeps the best round. The other files are its
  parts:
- derivatives.py goes from numbers for pixels back to the splats' parameters; adam.py takes steps down such a gradient;
- together.py takes such steps with one device or several;
- settling.py goes on while a file's roundings come one by one, photographs.py with photographs;
- fitted.py says what has come of it all.
"""
