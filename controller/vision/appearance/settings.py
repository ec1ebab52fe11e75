"""What a recipe says about colour and texture."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from controller.config.loader import StrictModel
from controller.errors import ConfigError


class Appearance(StrictModel):
    """Colour and texture of what was found."""

    colour: bool = True
    """Whether colours are measured and named."""
    texture: bool = True
    """Whether textures are measured and named."""
    reference: Literal["auto", "table", "patch", "none"] = "auto"
    """What tells the colour of the light. `table`: the empty table around each part, which is white or gray;
    `auto`: the same, but only where the table is bright and near enough to gray to be believed; `patch`: a gray
    card that lies in the picture at `patch_px`; `none`: the camera's own white balance."""
    table_reflectance: float = Field(0.6, gt=0.0, le=1.0)
    """Share of the light that the table gives back: white paper 0.85, light gray laminate 0.6."""
    patch_px: tuple[int, int, int, int] | None = None
    """(x, y, width, height) of the gray card in the picture."""
    patch_reflectance: float = Field(0.5, gt=0.0, le=1.0)
    """Share of the light that the gray card gives back."""

    @model_validator(mode="after")
    def _complete(self) -> Appearance:
        if self.reference == "patch" and self.patch_px is None:
            raise ConfigError("reference = patch, but patch_px is missing", "say where the gray card lies")
        if self.patch_px is not None and (min(self.patch_px[:2]) < 0 or min(self.patch_px[2:]) < 4):
            raise ConfigError("patch_px is no rectangle", "give [x, y, width, height], 4 px and more")
        return self
