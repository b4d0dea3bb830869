"""Coder BUNDLES of version 3: as :mod:`potr_cl.codec.context`, but in bundles of splats, and what is 0 told once.

Most AC coefficients are 0. So a *mask* a splat and degree tells the coefficients of which a channel is not, a *pattern*
each of these which channels, and only what is not 0 has a token. Bundles of splats need no other bundle, so that
threads share them out. docs/format.md, "Bundles", is the normative description.

:func:`potr_cl.codec.bundles.encoder.encode` and :class:`potr_cl.codec.bundles.decoder.Reader` are the two directions.
What both know: where items are coded (``layout``), the ``streams`` of a section with the terms of their contexts, the
``description`` that is stored, and range coding (``ranges``). ``fitting`` finds a scene's contexts.
"""
