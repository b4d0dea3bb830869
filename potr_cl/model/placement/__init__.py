"""What virtual cameras are placed with, NumPy alone. Begin with candidates.py.

- candidates.py draws views all around and inside a scene, says what each shows, and rejects the implausible ones;
- choice.py picks those that add most;
- matter.py knows where the scene is, how large, and what hides what from a place;
- colour_memory.py asks the colours from where they were trained;
- sampling.py spreads points evenly.
"""
