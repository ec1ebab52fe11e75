"""Recipes: what `detect` does to a frame, written down in a file."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from controller.config.files import named_or_path
from controller.config.loader import StrictModel, load_toml
from controller.errors import ConfigError
from controller.vision.appearance.settings import Appearance
from controller.vision.models.settings import Model


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
    """How far an outline may stray from its shape, px, ..."""
    misfit_share: float = Field(0.005, gt=0.0, le=0.1)
    """... plus this share of the object's size."""
    others: bool = True
    """Whether objects of no known shape are reported."""


class Ranges(StrictModel):
    """The paper's sorting by ranges of its variables; it publishes none, these are midpoints of ideal values."""

    four_sided_extent: float = Field(1.13, gt=1.0)
    """Squares and rectangles lie below."""
    circle_extent: float = Field(1.303, gt=1.0)
    circle_compactness: float = Field(1.05, gt=1.0)
    """Circles lie below both."""
    hexagon_extent: tuple[float, float] = (1.303, 1.5)
    hexagon_compactness: tuple[float, float] = (1.05, 1.19)
    """Hexagons lie within both."""
    square_difference: float = Field(0.1, gt=0.0)
    """Sides of a square differ by less than this share of the root of its area."""


class Unsharp(StrictModel):
    """Sharpen by unsharp masking."""

    op: Literal["unsharp_mask"]
    radius: float = Field(1.0, gt=0.0, le=50.0)
    amount: float = Field(0.8, ge=0.0, le=10.0)


class Gray(StrictModel):
    """To luminance."""

    op: Literal["gray"]


class Median(StrictModel):
    """Median smoothing."""

    op: Literal["median"]
    size: Literal[3, 5, 7] = 3


class Average(StrictModel):
    """Average smoothing."""

    op: Literal["average"]
    size: int = Field(3, ge=1, le=51)


class Gaussian(StrictModel):
    """Gaussian smoothing."""

    op: Literal["gaussian"]
    sigma: float = Field(1.0, gt=0.0, le=50.0)


class Stretch(StrictModel):
    """Contrast stretch that saturates the darkest and brightest shares."""

    op: Literal["stretch"]
    low: float = Field(0.01, ge=0.0, lt=0.5)
    high: float = Field(0.99, gt=0.5, le=1.0)


class Equalise(StrictModel):
    """Histogram equalisation."""

    op: Literal["equalise"]


class Homomorphic(StrictModel):
    """Even out the light in the logarithm."""

    op: Literal["homomorphic"]
    sigma_share: float = Field(0.15, gt=0.0, le=1.0)
    low_gain: float = Field(0.4, ge=0.0, le=1.0)
    high_gain: float = Field(1.2, ge=1.0, le=5.0)


class Canny(StrictModel):
    """Canny's edges; thresholds as shares of the strongest gradient, automatic when left out."""

    op: Literal["canny"]
    sigma: float = Field(math.sqrt(2.0), gt=0.1, le=20.0)
    low: float | None = Field(None, ge=0.0, lt=1.0)
    high: float | None = Field(None, gt=0.0, lt=1.0)

    @model_validator(mode="after")
    def _ordered(self) -> Canny:
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ConfigError("low is not below high", "swap or change them")
        return self


class Gradient(StrictModel):
    """Edges of a first derivative."""

    op: Literal["sobel", "prewitt", "roberts"]
    threshold: float | None = Field(None, gt=0.0, lt=1.0)


class ZeroCrossings(StrictModel):
    """Edges where the Laplacian of a Gaussian changes sign."""

    op: Literal["zero_crossings"]
    sigma: float = Field(2.0, gt=0.3, le=20.0)
    threshold: float | None = Field(None, gt=0.0)


class Otsu(StrictModel):
    """Threshold by Otsu's method."""

    op: Literal["otsu"]


class FrameDifference(StrictModel):
    """Sum of absolute differences to a picture of the empty table."""

    op: Literal["frame_difference"]
    threshold: float = Field(12.0, gt=0.0, le=255.0)
    block: int = Field(5, ge=1, le=99)


class TemplateMatch(StrictModel):
    """Find what looks like a picture, at several sizes."""

    op: Literal["template_match"]
    template: str = Field(min_length=1)
    """File with the picture of one object and a little of its surroundings."""
    scales: tuple[float, ...] = Field((0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0), min_length=1, max_length=50)
    threshold: float = Field(0.8, gt=0.0, le=1.0)


class FillHoles(StrictModel):
    """Fill what the background cannot reach."""

    op: Literal["fill_holes"]
    connectivity: Literal[4, 8] = 4


class AreaOpen(StrictModel):
    """Remove small components."""

    op: Literal["area_open"]
    pixels: int = Field(100, ge=1)
    """Smallest component kept, px of a 640 x 480 frame; larger frames scale it by their area."""


class Disk(StrictModel):
    """Opening or closing by a disk."""

    op: Literal["open_disk", "close_disk"]
    radius: int = Field(3, ge=0, le=50)


Stage = Annotated[
    Unsharp | Gray | Median | Average | Gaussian | Stretch | Equalise | Homomorphic | Canny | Gradient | ZeroCrossings
    | Otsu | FrameDifference | TemplateMatch | FillHoles | AreaOpen | Disk,
    Field(discriminator="op"),
]  # fmt: skip


class Recipe(StrictModel):
    """One way to detect."""

    schema_version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=60)
    about: str = ""
    method: Literal["precise", "stages"]
    """`precise` fits outlines; `stages` runs the stages below and classifies the components that remain."""
    precise: Precise = Precise()
    stages: tuple[Stage, ...] = ()
    ranges: Ranges = Ranges()
    appearance: Appearance = Appearance()
    model: Model | None = None
    """A trained model that names what was found."""

    @model_validator(mode="after")
    def _complete(self) -> Recipe:
        if self.method == "stages" and not self.stages:
            raise ConfigError("stages: there are none", "add [[stages]] entries, each with its op")
        if self.method == "precise" and self.stages:
            raise ConfigError("stages: method `precise` has none", 'set method = "stages" or remove them')
        return self


def load_recipe(name_or_path: str) -> Recipe:
    """The shipped recipe of that name (`precise`, `paper`, ...), or the one in a file.

    Raises:
        ConfigError: There is no such file, or it says something unknown or out of range.
    """
    return load_toml(named_or_path(name_or_path, "recipes"), Recipe)
