"""What is done to a scene on the way to a file.

stage.py says what a stage is. views_between.py, prune.py, fit.py, compact.py, refit.py and code.py are one stage each:
its options, and the order of its work. What they compute with is in the folders between/, pruning/, fitting/,
compaction/ and refitting/. What stages tell each other is in learnt.py, what they leave alone in guarded.py. The order
of the stages is not decided here: see :mod:`potr_cl.pipeline.presets`.
"""
