"""Which taught classes a run works with."""

from __future__ import annotations

import difflib
from pathlib import Path

from controller.config.cell import CellConfig
from controller.errors import ConfigError
from controller.service.folders import state_folder
from controller.vision.classes.store import load_classes
from controller.vision.classes.taught import Taught


def taught_classes(config: CellConfig) -> Taught | None:
    """The classes that the configuration names or its rules need; None when they ask for none.

    Raises:
        ConfigError: A rule asks for a label that was never taught.
        InputError: A class is damaged, or was taught with another version.
    """
    if not config.vision.classes and not config.taught_labels:
        return None
    folder = Path(config.vision.classes) if config.vision.classes else state_folder() / "classes"
    taught = Taught(load_classes(folder))
    names = taught.classifier.names
    for label in sorted(config.taught_labels - set(names)):
        close = difflib.get_close_matches(label, names, n=1, cutoff=0.6)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise ConfigError(
            f"a sorting rule asks for the label {label!r}, which was never taught ({folder})",
            f"{hint}teach it with controller teach, or name the folder with vision.classes",
        )
    return taught
