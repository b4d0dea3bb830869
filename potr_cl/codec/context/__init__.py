"""Context coder: streams of one integer a splat to bytes, each integer's code fitted to how large it should be.

An integer becomes a token (small ones by themselves, large ones by their magnitude, with the low bits stored as they
are) and tokens are coded by :mod:`potr_cl.codec.rans` with the frequencies of a context. The context is the size to
expect, a weighted sum of the sizes that are known already: of the streams before at the same splat, and of the same
stream at the splats before. Weights, classes and frequencies are fitted to the scene and stored. docs/format.md,
"Context coder", is the normative description.

:func:`potr_cl.codec.context.encoder.encode` and :class:`potr_cl.codec.context.decoder.Reader` are the two directions.
What both know: how splats lie in ``lanes``, what ``tokens`` integers become, and the ``model`` that is stored.
``fitting`` finds a scene's model.
"""
