"""Scenes from this package's own files. They are only read here: what makes them is the whole pipeline of encode."""

from __future__ import annotations

from potr_cl.codec.container import MAGIC
from potr_cl.codec.decoder import decode
from potr_cl.formats.declaration import SceneFormat

FORMAT = SceneFormat(
    name="potr_cl",
    suffixes=(".potr",),
    note="this package's own: what `encode` makes of a scene in any of these formats",
    load=decode,
    not_written="a .potr file is made by the command encode, which reads all that convert reads",
    starts=(MAGIC,),
    packed=True,
)
