"""What views are placed with, NumPy alone: without cameras (:mod:`potr_cl.placement`), and between given ones.

- given_views.py: what given views show, and where a camera might have been besides;
- matter.py: where the scene is, how large, and what hides what from a place;
- surface.py: points on the scene's surfaces; sampling.py: points spread evenly.
"""
