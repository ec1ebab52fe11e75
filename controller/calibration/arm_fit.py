"""The fit of base pose, joint offsets and marker mount to what the camera saw of the marker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from controller.calibration.arm import ArmCalibration, Residual, named
from controller.calibration.arm_model import MarkerView
from controller.errors import CalibrationPoorFit
from controller.geometry import invert

Array = NDArray[np.float64]

#: Eight corner coordinates a pose, fifteen unknowns, and enough left to judge the fit by.
MIN_POSES = 8
#: A pose whose whitened residual is worse than this is a misread marker or a bumped arm.
_OUTLIER = 4.0
#: At most this share of the poses may be dropped.
_OUTLIER_SHARE = 0.25
#: Data must tell every unknown at least this much better than what was assumed of it.
_LEAST_SINGULAR = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One look at the marker.

    Attributes:
        encoders: ndarray of shape (J,), what the servos said, rad.
        corners: ndarray of shape (4, 2), where the camera saw the marker, px.
    """

    encoders: Array
    corners: Array


def fit_arm(
    view: MarkerView, observations: Sequence[Observation], camera_id: str = "", table_id: str = ""
) -> ArmCalibration:
    """Base, joint offsets and mount that explain the observations best, each weighted by what it is worth.

    Raises:
        CalibrationPoorFit: Too few poses, poses that leave an unknown open, or observations that no arm
            of this kind can have caused.
    """
    encoders = np.array([o.encoders for o in observations])
    corners = np.array([o.corners.ravel() for o in observations])
    _enough(len(observations))
    drop = int(_OUTLIER_SHARE * len(observations))
    while True:
        parameters, whitener = _solve(view, encoders, corners)
        white = np.einsum("nij,nj->ni", whitener, corners - view.predict(parameters, encoders))
        misfit = np.sqrt((white**2).mean(axis=1))
        worst = int(np.argmax(misfit))
        if misfit[worst] <= _OUTLIER:
            break
        if drop == 0 or len(encoders) <= MIN_POSES:
            raise CalibrationPoorFit(
                f"the marker is not where this arm can have it: {misfit[worst]:.1f} times the expected error",
                "check that arm, board and marker are the configured ones and that nothing was bumped; repeat",
            )
        drop -= 1
        encoders, corners = np.delete(encoders, worst, axis=0), np.delete(corners, worst, axis=0)
    rows = (whitener @ view.jacobian(parameters, encoders)).reshape(-1, len(parameters))
    singular = np.linalg.svd(rows * view.prior, compute_uv=False)
    if singular[-1] < _LEAST_SINGULAR:
        raise CalibrationPoorFit(
            f"the poses do not tell all joint offsets apart (smallest singular value {singular[-1]:.2f})",
            "take more poses, with the tool tilted and the last joint turned both ways",
        )
    covariance = np.linalg.inv(rows.T @ rows + np.diag(view.prior**-2.0))
    deviation = np.sqrt(np.diag(covariance))
    found = view.unknowns(parameters)
    names = [joint.name for joint in view.arm.joints]
    spread = {names[joint]: float(deviation[12 + k]) for k, joint in enumerate(view.free_joints)}
    spread |= {axis: float(value) for axis, value in zip(("x", "y", "z"), deviation[3:6], strict=True)}
    return named(
        ArmCalibration(
            "",
            camera_id,
            table_id,
            view.arm.name,
            invert(found.T_table_base),
            {name: float(value) for name, value in zip(names, found.offsets, strict=True)},
            found.T_tool_marker,
            Residual.of(distances(view, parameters, encoders, corners)),
            len(encoders),
            tuple(float(value) for value in singular),
            spread | {"yaw": float(deviation[2])},
            tuple((float(x), float(y), float(z)) for x, y, z in view.tools(found, encoders)),
        )
    )


def distances(view: MarkerView, parameters: Array, encoders: Array, corners: Array) -> Array:
    """How far (N,) the marker's middle was seen from where the model has it, mm at its depth."""
    points = view.in_camera(view.unknowns(parameters), encoders)
    off = (corners - view.predict(parameters, encoders)).reshape(-1, 4, 2).mean(axis=1)
    depth = points[..., 2].mean(axis=1)
    return np.asarray(np.linalg.norm(off / np.diag(view.camera.matrix)[:2], axis=1) * depth)


def _enough(count: int) -> None:
    if count < MIN_POSES:
        raise CalibrationPoorFit(
            f"the marker was seen at only {count} poses, {MIN_POSES} are needed",
            "check light, focus and that the marker faces the camera while the tool points down",
        )


def _solve(view: MarkerView, encoders: Array, corners: Array) -> tuple[Array, Array]:
    """Parameters (P,) and the weights (N, 8, 8) they were found with; the assumptions take part as data."""
    parameters = np.zeros(len(view.prior))
    for _ in range(2):  # the weights hang on the parameters only a little
        whitener = view.whitener(parameters, encoders)

        def residuals(at: Array, by: Array = whitener) -> Array:
            white = np.einsum("nij,nj->ni", by, corners - view.predict(at, encoders))
            return np.concatenate([white.ravel(), at / view.prior])

        def derivative(at: Array, by: Array = whitener) -> Array:
            white = -(by @ view.jacobian(at, encoders)).reshape(-1, len(at))
            return np.vstack([white, np.diag(1.0 / view.prior)])

        # A first guess may be off by many px: bounded influence brings it in, squares finish it.
        for loss in ("soft_l1", "linear"):
            solution = least_squares(residuals, parameters, jac=derivative, x_scale=view.prior, loss=loss)
            parameters = np.asarray(solution.x, np.float64)
    return parameters, whitener
