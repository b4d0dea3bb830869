"""The codec's C functions (:mod:`potr_cl.native`), each given NumPy arrays whose sizes have been checked here."""
