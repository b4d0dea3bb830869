"""What is done to a scene on the way to a file.

stage.py says what a stage is, and what stages tell each other. views_between.py, prune.py, fit.py, compact.py, refit.py
and code.py are one stage each: its options, and the order of its work. What they compute with is in the folders
pruning/, fitting/, compaction/ and refitting/; unseen.py has the splats that views do not show, held_out.py the views
that judge. The order of the stages is not decided here: see :mod:`potr_cl.pipeline.presets`.
"""
