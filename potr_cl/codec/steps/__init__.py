"""Steps of colours that fit each splat: finer where an error shows more.

:mod:`potr_cl.codec.steps.rule` has what a file says and what follows from it, :mod:`potr_cl.codec.steps.fitting` finds
it for a scene, and :mod:`potr_cl.codec.steps.prediction` predicts colours whose steps differ.
"""
