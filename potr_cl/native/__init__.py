"""The native path: what takes most of the host's time, in C, which ``pip install`` builds where there is a compiler.

It gives the same bits as the NumPy that is its definition, and what runs where it is not there.
:data:`potr_cl.native.table.TABLE` says which C function stands for which definition, and
:func:`potr_cl.native.library.native` whether there are any. The C sources lie beside this file:

====================  =========================================================================================
``bundles.c``         :mod:`potr_cl.codec.bundles`: a bundle's integers
``steps.c``           :mod:`potr_cl.codec.steps.rule`: classes of the steps of colours
``bundles_tokens.c``  :mod:`potr_cl.codec.bundles.ranges`: tokens of the streams of a bundle
``bundles_values.c``  :mod:`potr_cl.codec.dequantizer`: their values, while they are in a cache
``bundles_share.c``   :mod:`potr_cl.codec.dequantizer`: how threads share bundles out
``prediction.h``      :mod:`potr_cl.codec.steps.prediction`: DC from what its prediction has left
``bundles_encode.c``  :mod:`potr_cl.codec.bundles.encoder`: what contexts are fitted to, and range coding
``bundles_fit.c``     :mod:`potr_cl.codec.bundles.fitting`: contexts from counts
``octree.c``          :mod:`potr_cl.codec.octree`: streams to centres
``octree_build.c``    :mod:`potr_cl.codec.octree`: centres to streams
``quantise.c``        the encoder's loops over all splats
``visibility.c``      :mod:`potr_cl.model.matter`, :mod:`potr_cl.model.spherical_harmonics`: what a camera sees
``module.c``          nothing: it makes a Python module of the library, so that it is built and found as one
====================  =========================================================================================

Who calls a function, beside its definition or in :mod:`potr_cl.codec.native`, gives it NumPy arrays whose sizes have
been checked; ``library`` finds the library.
"""
