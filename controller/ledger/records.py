"""From the nouns to rows: what is written down about a target, with the unit in every column's name."""

from __future__ import annotations

import math

from controller.domain import LocatedObject, PickPlan

Row = dict[str, object]

# Columns of a target as it was located, and of the plan to pick it, with their SQL types.
OBJECT_COLUMNS: dict[str, str] = {
    "frame_id": "INTEGER",
    "frame_source": "TEXT",
    "captured_at_s": "REAL",
    "calibration_id": "TEXT",
    "shape": "TEXT",
    "label": "TEXT",
    "score": "REAL",
    "colour": "TEXT",
    "texture": "TEXT",
    "x_mm": "REAL",
    "y_mm": "REAL",
    "yaw_deg": "REAL",
    "long_mm": "REAL",
    "short_mm": "REAL",
    "height_mm": "REAL",
    "sigma_mm": "REAL",
}
PLAN_COLUMNS: dict[str, str] = {
    "bin": "TEXT",
    "grasp_x_mm": "REAL",
    "grasp_y_mm": "REAL",
    "grasp_height_mm": "REAL",
    "grasp_direction_deg": "REAL",
    "grasp_width_mm": "REAL",
    "grasp_opening_mm": "REAL",
    "grasp_clearance_mm": "REAL",
}


def object_row(target: LocatedObject) -> Row:
    """The columns of a located object."""
    detection = target.detection
    return {
        "frame_id": detection.frame.frame_id,
        "frame_source": detection.frame.source,
        "captured_at_s": float(detection.frame.captured_at),
        "calibration_id": target.calibration_id,
        "shape": str(detection.shape),
        "label": detection.label,
        "score": float(detection.score),
        "colour": detection.colour,
        "texture": detection.texture,
        "x_mm": float(target.center[0]),
        "y_mm": float(target.center[1]),
        "yaw_deg": None if target.yaw is None else math.degrees(target.yaw),
        "long_mm": float(target.size[0]),
        "short_mm": float(target.size[1]),
        "height_mm": float(target.height),
        "sigma_mm": float(target.sigma),
    }


def plan_row(plan: PickPlan | None) -> Row:
    """The columns of a plan; all None when there is none."""
    if plan is None:
        return dict.fromkeys(PLAN_COLUMNS)
    grasp = plan.grasp
    return {
        "bin": plan.bin.name,
        "grasp_x_mm": float(grasp.center[0]),
        "grasp_y_mm": float(grasp.center[1]),
        "grasp_height_mm": float(grasp.height),
        "grasp_direction_deg": math.degrees(grasp.direction),
        "grasp_width_mm": float(grasp.width),
        "grasp_opening_mm": float(grasp.opening),
        # Infinite where nothing else is near; a record has no number for that.
        "grasp_clearance_mm": float(grasp.clearance) if math.isfinite(grasp.clearance) else None,
    }
