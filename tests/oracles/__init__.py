"""Independent references in float64, and a decoder written from docs/format.md alone: what results are compared
with.
"""
