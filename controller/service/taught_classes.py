"""Which taught classes a run works with."""

from __future__ import annotations

import difflib
from pathlib import Path

from controller.config.cell import CellConfig
from controller.errors import ConfigError
from controller.service.folders import state_folder
from controller.vision.classes.store import load_classes
from controller.vision.classes.taught import Taught
from controller.vision.models.network import network
from controller.vision.recipe import Recipe


def taught_classes(config: CellConfig, recipe: Recipe) -> Taught | None:
    """The classes that the configuration names or its rules need; None when they ask for none.

    Labels that the recipe's trained model gives need not have been taught.

    Raises:
        ConfigError: A rule asks for a label that was never taught.
        ConfigError: The recipe's trained model is not what the recipe says.
        InputError: A class is damaged, or was taught with another version.
    """
    wanted = config.taught_labels
    if recipe.model is not None:
        # A model that cannot be used is refused before anything moves.
        wanted = wanted - set(network(recipe.model).settings.labels)
    if not config.vision.classes and not wanted:
        return None
    folder = Path(config.vision.classes) if config.vision.classes else state_folder() / "classes"
    taught = Taught(load_classes(folder))
    names = taught.classifier.names
    for label in sorted(wanted - set(names)):
        close = difflib.get_close_matches(label, names, n=1, cutoff=0.6)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ConfigError(
            f"a sorting rule asks for the label {label!r}, which was never taught ({folder})",
            f"{hint}teach it with controller teach, or name the folder with vision.classes",
        )
    return taught
