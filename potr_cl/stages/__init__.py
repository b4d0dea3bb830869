"""What is done to a scene on the way to a file.

stage.py says what a stage is. prune.py, compact.py, refit.py and code.py are one stage each: its options, and the order
of its work. What the first three compute with is in the folders pruning/, compaction/ and refitting/. The order of the
stages is not decided here: see :mod:`potr_cl.pipeline.presets`.
"""
