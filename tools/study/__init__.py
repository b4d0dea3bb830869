"""Experiments: what a choice costs or brings, against the alternatives."""
