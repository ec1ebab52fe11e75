"""What the simulated cell is built from, out of the configuration of a real one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from controller.backends.devices import BackendOptions
from controller.backends.nominal import nominal_camera
from controller.config.cell import CellConfig
from controller.domain import ArmDescription, Array, Shape
from controller.errors import InputError

if TYPE_CHECKING:
    from sim_backends.cell import SimulatedCell
    from sim_backends.cell_spec import CellSpec

_LANDMARKS = ((1, 110.0, 290.0), (2, 110.0, -290.0), (3, -80.0, 305.0), (4, -80.0, -305.0))
"""Where the simulated table's corner markers lie, (id, x, y) in `table`, mm: in view, out of the work area."""


def simulated_cell() -> type[SimulatedCell]:
    """The class of the simulated cell, which needs the extra `sim`.

    Raises:
        InputError: The extra is not installed.
    """
    try:
        from sim_backends.cell import SimulatedCell
    except ImportError as error:
        raise InputError(
            f"the simulation cannot start: {error}", "install its extra: pip install 'sorting-controller[sim]'"
        ) from error
    return SimulatedCell


def cell_spec(config: CellConfig, arm: ArmDescription, options: BackendOptions) -> CellSpec:
    """The simulated cell that a configuration describes."""
    from sim_backends.cell_spec import CellSpec
    from sim_backends.parts import Kind, WorkArea

    area = config.table.work_area
    T_base_table = config.table.T_base_table()
    _, T_table_camera = nominal_camera(config)
    return CellSpec(
        arm=arm,
        bins=config.bin_values(),
        T_base_table=_rows(T_base_table),
        T_base_camera=_rows(T_base_table @ T_table_camera),
        image_size=(config.camera.width, config.camera.height),
        field_of_view=math.radians(config.camera.field_of_view_deg),
        parts=options.parts,
        seed=options.seed,
        level=str(options.level),
        disturb=options.disturb,
        round_part=True,
        heights={shape: config.part(shape).height_mm for shape in Shape},
        landmarks=_LANDMARKS if config.table.corner_markers else (),
        kinds=tuple(
            Kind(kind.name, kind.shape, kind.colour, kind.marking, kind.width_mm) for kind in config.simulated_kinds
        ),
        # The controller knows its own place to some mm and a degree: what lies on the rim may be out for it.
        work_area=WorkArea(
            radius=(area.inner_radius_mm + 4.0, area.outer_radius_mm - 4.0),
            azimuth=(math.radians(area.azimuth_deg[0] + 2.0), math.radians(area.azimuth_deg[1] - 2.0)),
        ),
    )


def _rows(pose: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in pose)
