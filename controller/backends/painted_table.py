"""A simulated camera over a table without an arm at work: for studies of seeing alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from controller.backends.devices import BackendOptions
from controller.backends.simulated_spec import cell_spec, simulated_cell
from controller.config.cell import CellConfig, KindSection
from controller.domain import ArmDescription, Frame, Point, Shape, TruePart
from controller.geometry import transform
from controller.ports import Camera, Clock, Presenter


class PaintedTable:
    """A simulated camera over a table on which parts are laid at will: for studies of seeing alone.

    Args:
        config: The cell.
        arm: It stands out of view.
        options: Of the simulated world.
        imperfections: Single ones that replace the level's, by name.

    Attributes:
        camera, clock, presenter: The ports, over an empty table; the camera is open.
    """

    def __init__(
        self,
        config: CellConfig,
        arm: ArmDescription,
        options: BackendOptions,
        imperfections: Mapping[str, float] | None = None,
    ) -> None:
        cell_type = simulated_cell()
        # The arm stands away from the scene, turned to the side: neither it nor its shadow is in the picture.
        table = config.table.model_copy(update={"origin_in_base_mm": (380.0, 0.0, 0.0)})
        aside = replace(arm, rest=(math.pi / 2, *arm.rest[1:]))
        spec = cell_spec(config.model_copy(update={"table": table}), aside, options)
        self._spec = replace(spec, bins=(), overrides=imperfections or {}, round_part=False)
        empty = cell_type(self._spec, ())
        self._T_base_table = empty.T_base_table
        empty.camera.open()
        self.camera: Camera = empty.camera
        self.clock: Clock = empty.clock
        self.presenter: Presenter = empty.presenter

    def show(
        self,
        parts: Sequence[tuple[Shape, Point, float]],
        widths: Sequence[float],
        seed: int,
        kind: KindSection | None = None,
    ) -> tuple[Frame, Sequence[TruePart]]:
        """A picture of parts laid at (shape, (x, y) in `table`, yaw), mm and rad; and where they truly are.

        Args:
            parts: What to lay.
            widths: Extents between the jaws to choose from, mm.
            seed: Of widths and colours.
            kind: All are of this kind.
        """
        from sim_backends.parts import COLOURS, Part

        random = np.random.default_rng([seed, 11])
        turn = math.atan2(self._T_base_table[1, 0], self._T_base_table[0, 0])
        laid = []
        for shape, center, yaw in parts:
            x, y, _ = transform(self._T_base_table, [*center, 0.0])
            colour, grip = random.choice(list(COLOURS)), random.choice(widths)
            part = Part(shape, str(colour), float(grip), self._spec.heights[shape], 0.02, 0.5, x, y, yaw + turn)
            if kind is not None:
                part = replace(part, colour=kind.colour, marking=kind.marking, kind=kind.name)
            laid.append(part)
        cell = simulated_cell()(self._spec, laid)
        cell.camera.open()
        frame = cell.camera.capture(cell.clock.now())
        return frame, cell.truth_at(frame.captured_at)
