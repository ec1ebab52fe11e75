"""What a recipe says about a trained model: which file, what goes in, what comes out."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from controller.config.loader import StrictModel
from controller.errors import ConfigError

MOST_BYTES = 200_000_000
"""Largest model file that is read."""
_MOST_INPUT = 4_000_000
_MOST_OUTPUT = 4_000_000
_COLUMNS = 6
"""Of a row of layout `corners`: x0, y0, x1, y1, score, class."""


class Model(StrictModel):
    """A trained model: a classifier of single parts, or a detector of the whole picture."""

    file: str = Field(min_length=1)
    """Name of a shipped model, or the path of an ONNX file of your own."""
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    """Checksum of that file: another file is another model."""
    task: Literal["classify", "detect"] = "classify"
    """`classify` names every object that was found; `detect` looks at the whole picture and gives boxes: each names
    the object whose box it covers, and one without an object is reported as a box of its own."""
    input: tuple[int, int, int, int]
    """Shape of the input: pictures at a time (0 for any number), channels (1 or 3), height, width."""
    output: tuple[int, ...] = Field(min_length=2, max_length=3)
    """Shape of the output; 0 stands for the number of pictures, or of boxes."""
    labels: tuple[str, ...] = Field(min_length=1, max_length=1000)
    """What its classes are called, in order."""
    values: Literal["probabilities", "logits"] = "probabilities"
    """Whether scores are shares of 1 already."""
    layout: Literal["corners", "centres"] = "corners"
    """Of a detector's output. `corners`: a row a box, x0, y0, x1, y1, score, class; `centres`: a column a box,
    x, y, width, height and a score for each class. Both in pixels of the input."""
    colours: Literal["rgb", "bgr"] = "rgb"
    """Order of three channels."""
    scale: float = Field(1.0 / 255.0, gt=0.0, le=1.0)
    """What codes of 0 to 255 are multiplied by, after ..."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """... these have been taken off, in the order of the channels."""
    margin: float = Field(1.15, ge=1.0, le=4.0)
    """A classifier sees a square this many times as wide as the circle around the part."""
    least: float = Field(0.5, ge=0.0, le=1.0)
    """Scores below name nothing."""
    runtime: Literal["opencv", "onnxruntime"] = "opencv"
    """What runs it; onnxruntime is an extra of its own, for networks that OpenCV does not know all layers of."""

    @model_validator(mode="after")
    def _consistent(self) -> Model:
        count, channels, height, width = self.input
        if channels not in (1, 3) or count < 0 or height < 8 or width < 8:
            raise ConfigError(f"input = {list(self.input)} is no picture", "give [pictures, 1 or 3, height, width]")
        if max(count, 1) * channels * height * width > _MOST_INPUT:
            raise ConfigError(f"input = {list(self.input)} is too large", f"{_MOST_INPUT} values are the most")
        if min(self.output) < 0 or _product(self.output) > _MOST_OUTPUT:
            raise ConfigError(f"output = {list(self.output)} is out of range", f"{_MOST_OUTPUT} values are the most")
        if self.task == "classify":
            wanted, columns = len(self.labels), self.output[-1]
        else:
            wanted = _COLUMNS if self.layout == "corners" else 4 + len(self.labels)
            columns = self.output[-1 if self.layout == "corners" else -2]
        if columns != wanted:
            raise ConfigError(
                f"output = {list(self.output)} has {columns} places, {len(self.labels)} labels need {wanted}",
                "mend output or labels",
            )
        if len(set(self.labels)) != len(self.labels):
            raise ConfigError("two labels are the same", "give every class its own name")
        return self


def _product(values: tuple[int, ...]) -> int:
    out = 1
    for value in values:
        out *= max(value, 1)
    return out
