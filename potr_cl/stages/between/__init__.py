"""What the stage "between" computes with.

amount.py decides how many views a scene needs, and room.py how many of these fit the memory; price.py says what a splat
may cost where views show a part of the scene.
"""
