"""Everything about a configuration that only arm and rules together can tell, before anything is opened."""

from __future__ import annotations

from controller.config.cell import CellConfig
from controller.domain import ArmDescription
from controller.errors import ConfigError
from controller.motion.planner import Planner


def check(config: CellConfig, arm: ArmDescription, planner: Planner) -> list[str]:
    """Refuse what cannot work, and say what is odd.

    Args:
        config: The cell.
        arm: Its arm.
        planner: A planner for that arm with the best calibration known, the ruler's if need be.

    Returns:
        Warnings, one line each.

    Raises:
        ConfigError: A bin cannot be reached.
    """
    for index, bin_ in enumerate(config.bin_values()):
        error = planner.bin_error(bin_)
        if error is not None:
            raise ConfigError(
                f"bins[{index}] ({bin_.name}) at {bin_.center[0]:.0f}, {bin_.center[1]:.0f} mm cannot be reached by "
                f"{arm.title}: {error}",
                "move it closer or lower its walls",
            )
    warnings = []
    used = {rule.bin for rule in config.sorting.rules} | {config.sorting.otherwise}
    warnings += [f"bin {bin_.name} is named by no rule" for bin_ in config.bins if bin_.name not in used]
    rules = config.sorting.rules
    for index, rule in enumerate(rules[:-1]):
        if rule.shape is None and rule.label is None and rule.size_mm is None:
            warnings.append(f"sorting.rules[{index}] matches everything: the rules after it never do")
    return warnings
