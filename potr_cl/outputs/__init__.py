"""What an encode ends in: one module a kind of file, and the table of all, :mod:`potr_cl.outputs.registry`."""
