"""Input that means harm: how it is made for each format (FORMATS in formats.py), and how what reads it is judged."""
