"""Recipes: what `detect` does to a frame, written down in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from controller.config.files import shipped
from controller.config.loader import StrictModel, load_toml

NAMED = ("precise", "paper")
"""Recipes that ship with the program and can be called by name."""


class Precise(StrictModel):
    """Outlines searched in colour, fitted, refined to sub-pixel and judged."""

    smallest_px: float = Field(12.0, ge=4.0, le=1000.0)
    """Smallest width of an object worth reporting, px of the full frame."""
    level: float = Field(4.5, ge=2.0, le=50.0)
    """How far from the table's colour, in standard deviations, a pixel must be to be part of a proposal."""
    minimum_contrast: float = Field(6.0, ge=1.0, le=255.0)
    """Smallest step at the outline that is believed, gray levels."""
    square_aspect: float = Field(1.1, gt=1.0, le=2.0)
    """Rectangles whose sides differ by less than this ratio are squares."""
    visible: float = Field(0.8, gt=0.0, le=1.0)
    """Share of an outline that must be seen as an edge."""
    misfit_px: float = Field(0.10, gt=0.0, le=10.0)
    misfit_share: float = Field(0.004, gt=0.0, le=0.1)
    """How far an outline may stray from its shape: so many px plus this share of its size."""
    others: bool = True
    """Whether objects of no known shape are reported."""


class Recipe(StrictModel):
    """One way to detect."""

    schema_version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=60)
    about: str = ""
    method: Literal["precise"]
    precise: Precise = Precise()


def load_recipe(name_or_path: str) -> Recipe:
    """The recipe called `precise` or `paper`, or the one in a file.

    Raises:
        ConfigError: There is no such file, or it says something unknown or out of range.
    """
    path = shipped(f"recipes/{name_or_path}.toml") if name_or_path in NAMED else Path(name_or_path)
    return load_toml(path, Recipe)
