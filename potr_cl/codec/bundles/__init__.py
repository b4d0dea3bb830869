"""The coder of splats' integers: each one's code fitted to how large it should be, in bundles that need no other.

An integer becomes a token (small ones by themselves, large ones by their magnitude, with their low bits beside), and
tokens are range coded with the frequencies of a context. The context is the size to expect: a weighted sum of the sizes
that are known already, of other properties of the splat and of the splats before. Weights, contexts and frequencies are
fitted to the scene and stored, or are those that every decoder knows, where a scene is too small to pay for its own.

Most AC coefficients are 0. So a *mask* a splat and degree tells the coefficients of which a channel is not, a *pattern*
each of these which channels, and only what is not 0 has a token. Bundles of splats need no other bundle, so that
threads share them out. docs/format.md, "Bundles", is the normative description.

:func:`potr_cl.codec.bundles.encoder.encode` and :class:`potr_cl.codec.bundles.decoder.Reader` are the two directions.
What both know: where items are coded (``layout``), the ``streams`` of a section with the terms of their contexts, the
``description`` that is stored, and range coding (``ranges``). ``fitting`` finds a scene's contexts.
"""
