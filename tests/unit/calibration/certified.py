"""A certificate for a calibration that a test trusts: its touch test takes longer than most tests may."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from controller.calibration import files
from controller.calibration.store import CERTIFICATE, load


def certify(folder: Path, **changed: Any) -> None:
    """Write what `calibrate check` would have written, `changed` put over it."""
    stored = load(folder)
    assert stored.arm is not None
    content: dict[str, Any] = {
        "touch_mm": {"mean": 0.3, "p95": 0.5, "max": 0.6},
        "verdict": "passed",
        "calibration_id": stored.arm.calibration_id,
        "camera_id": stored.camera.calibration_id,
        "table_id": stored.table.calibration_id,
        "made_at": datetime.now().astimezone().isoformat(),
        **changed,
    }
    files.write(folder / CERTIFICATE, content | {"certificate_id": files.identity("certificate", content)})
