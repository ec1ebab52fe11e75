"""What was detected, as the JSON that the command line prints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from controller.domain import Detection, Frame, LocatedObject
from controller.vision.detect import Detected


def detection_json(
    image_name: str, frame: Frame, recipe_name: str, detected: Detected, located: Sequence[LocatedObject] = ()
) -> dict[str, Any]:
    """One image's detections as a JSON-ready mapping; mm fields only for detections that are in `located`."""
    on_table = {id(item.detection): item for item in located}
    return {
        "image": image_name,
        "size": list(frame.size),
        "recipe": recipe_name,
        "timing_ms": {stage: round(value, 3) for stage, value in detected.timing_ms.items()},
        "objects": [_object_json(item, on_table.get(id(item))) for item in detected.detections],
    }


def _object_json(item: Detection, located: LocatedObject | None) -> dict[str, Any]:
    out: dict[str, Any] = {
        "shape": str(item.shape),
        "label": item.label or str(item.shape),
        "score": round(item.score, 4),
        "center_px": [round(value, 4) for value in item.center_px],
        "angle_deg": None if item.angle is None else round(math.degrees(item.angle), 4),
        "area_px": round(item.area_px, 2),
        "size_px": [round(value, 3) for value in item.size_px],
        "bbox_px": [round(value, 3) for value in item.bbox_px],
        "outline_px": [[round(float(u), 3), round(float(v), 3)] for u, v in item.outline_px],
        "flags": sorted(item.flags),
        "colour": item.colour,
        "texture": item.texture,
        "descriptors": {
            "extent": round(item.descriptors.extent, 4),
            "compactness": round(item.descriptors.compactness, 4),
            "side_difference": round(item.descriptors.side_difference, 3),
        },
    }
    if located is not None:
        out["center_mm"] = [round(value, 4) for value in located.center]
        out["angle_table_deg"] = None if located.yaw is None else round(math.degrees(located.yaw), 4)
        out["size_mm"] = [round(value, 4) for value in located.size]
        out["height_mm"] = round(located.height, 3)
        out["sigma_mm"] = round(located.sigma, 4)
    return out
