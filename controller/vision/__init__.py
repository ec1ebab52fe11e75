"""Vision: from a frame to the objects in it, in pixels.

`detect` runs a recipe. The recipe `precise` looks for outlines and fits shapes to them; a recipe of stages,
such as `paper`, composes textbook operators into a binary picture and classifies its components.
"""
