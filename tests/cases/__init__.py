"""Scenes and cameras that tests build."""
