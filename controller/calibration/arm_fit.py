"""The fit of base pose, joint offsets and marker mount to what the camera saw of the marker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from controller.calibration.arm import ArmCalibration, Residual, named
from controller.calibration.arm_model import MarkerView
from controller.calibration.arm_touch import MIN_TOUCHES, REACH_SIGMA, Touch, predict, whitener
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
    view: MarkerView,
    observations: Sequence[Observation],
    camera_id: str = "",
    table_id: str = "",
    touches: Sequence[Touch] = (),
) -> ArmCalibration:
    """Base, joint offsets and mount that explain the observations best, each weighted by what it is worth.

    Args:
        view: The cell as known so far.
        observations: Looks at the marker.
        camera_id: Of the lens the looks rest on.
        table_id: Of the table.
        touches: Pushes of a round part; too few of them, or all to one side, are left out.

    Raises:
        CalibrationPoorFit: Too few poses, poses that leave an unknown open, or observations that no arm
            of this kind can have caused.
    """
    seen = _Seen.of(observations, touches)
    view = replace(view, touched=bool(seen.touches))
    _enough(len(observations))
    drop = int(_OUTLIER_SHARE * len(observations))
    while True:
        parameters, weights = _solve(view, seen)
        misfit = np.sqrt((_white(view, seen, weights, parameters)[0] ** 2).mean(axis=1))
        worst = int(np.argmax(misfit))
        if misfit[worst] <= _OUTLIER:
            break
        if drop == 0 or len(seen.encoders) <= MIN_POSES:
            raise CalibrationPoorFit(
                f"the marker is not where this arm can have it: {misfit[worst]:.1f} times the expected error",
                "check that arm, board and marker are the configured ones and that nothing was bumped; repeat",
            )
        drop -= 1
        seen = replace(
            seen, encoders=np.delete(seen.encoders, worst, axis=0), corners=np.delete(seen.corners, worst, axis=0)
        )
    beside = _white(view, seen, weights, parameters)[1]
    if len(beside) and (off := float(np.sqrt((beside**2).mean(axis=1)).max())) > _OUTLIER:
        raise CalibrationPoorFit(
            f"the part that was touched is not where this arm can have pushed it: {off:.1f} times the expected error",
            "lay one round part, not worn and of the configured height, on a table it slides on; repeat",
        )
    assumed = _assumed(view, seen)
    rows = -_slopes(view, seen, weights, parameters)
    singular = np.linalg.svd(rows * assumed, compute_uv=False)
    if singular[-1] < _LEAST_SINGULAR:
        raise CalibrationPoorFit(
            f"the poses do not tell all joint offsets apart (smallest singular value {singular[-1]:.2f})",
            "take more poses, with the tool tilted and the last joint turned both ways",
        )
    covariance = np.linalg.inv(rows.T @ rows + np.diag(assumed**-2.0))
    deviation = np.sqrt(np.diag(covariance))
    of_view = parameters[: len(view.prior)]
    found = view.unknowns(of_view)
    names = [joint.name for joint in view.arm.joints]
    spread = {names[joint]: float(deviation[12 + k]) for k, joint in enumerate(view.free_joints)}
    spread |= {axis: float(value) for axis, value in zip(("x", "y", "z"), deviation[3:6], strict=True)}
    of_jaws = deviation[12 + len(view.free_joints) : len(view.prior)]
    spread |= {f"jaws_{axis}": float(value) for axis, value in zip(view.free_jaws, of_jaws, strict=True)}
    return named(
        ArmCalibration(
            "",
            camera_id,
            table_id,
            view.arm.name,
            invert(found.T_table_base),
            {name: float(value) for name, value in zip(names, found.offsets, strict=True)},
            found.T_tool_marker,
            Residual.of(distances(view, of_view, seen.encoders, seen.corners)),
            len(seen.encoders),
            tuple(float(value) for value in singular),
            spread | {"yaw": float(deviation[2])},
            tuple((float(x), float(y), float(z)) for x, y, z in view.tools(found, seen.encoders)),
            len(seen.touches),
            jaws=found.jaws,
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


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What a fit rests on: poses (N, J) with the marker's corners (N, 8), and touches with their centres (M, 2)."""

    encoders: Array
    corners: Array
    touches: tuple[Touch, ...]

    @classmethod
    def of(cls, observations: Sequence[Observation], touches: Sequence[Touch]) -> _Seen:
        """Touches count when they came from both sides: how far before the jaws a part lies cancels between them."""
        both = len(touches) >= MIN_TOUCHES and len({touch.side for touch in touches}) > 1
        encoders = np.array([o.encoders for o in observations])
        return cls(encoders, np.array([o.corners.ravel() for o in observations]), tuple(touches) if both else ())

    @property
    def touching(self) -> Array:
        """Encoder angles (M, J) of the touches."""
        return np.array([touch.encoders for touch in self.touches])

    @property
    def centers(self) -> Array:
        """Where the parts were seen, (M, 2)."""
        return np.array([touch.center for touch in self.touches])


@dataclass(frozen=True, slots=True, eq=False)
class _Weights:
    """Inverse Cholesky factors: (N, 8, 8) of the poses, (M, 2, 2) of the touches."""

    poses: Array
    touches: Array


def _assumed(view: MarkerView, seen: _Seen) -> Array:
    """Standard deviations of all parameters before anything was seen; with touches the last is what `reach` lacks."""
    return np.append(view.prior, REACH_SIGMA) if seen.touches else view.prior


def _white(view: MarkerView, seen: _Seen, weights: _Weights, at: Array) -> tuple[Array, Array]:
    """Whitened residuals of poses (N, 8) and touches (M, 2)."""
    poses = np.einsum("nij,nj->ni", weights.poses, seen.corners - view.predict(at[: len(view.prior)], seen.encoders))
    if not seen.touches:
        return poses, np.empty((0, 2))
    beside = seen.centers - predict(view, at, seen.touches, seen.touching)
    return poses, np.einsum("nij,nj->ni", weights.touches, beside)


def _slopes(view: MarkerView, seen: _Seen, weights: _Weights, at: Array) -> Array:
    """Derivatives of the whitened residuals, all poses' and then all touches'."""
    of_view = len(view.prior)
    poses = -(weights.poses @ view.jacobian(at[:of_view], seen.encoders)).reshape(-1, of_view)
    if not seen.touches:
        return poses
    columns = []
    for index, step in enumerate(1e-4 * _assumed(view, seen)):
        turn = np.zeros(len(at))
        turn[index] = step
        ahead = predict(view, at + turn, seen.touches, seen.touching)
        columns.append((ahead - predict(view, at - turn, seen.touches, seen.touching)) / (2 * step))
    beside = -np.einsum("nij,pnj->nip", weights.touches, np.array(columns)).reshape(-1, len(at))
    return np.vstack([np.column_stack([poses, np.zeros(len(poses))]), beside])


def _solve(view: MarkerView, seen: _Seen) -> tuple[Array, _Weights]:
    """Parameters and the weights they were found with; the assumptions take part as data."""
    assumed = _assumed(view, seen)
    parameters = np.zeros(len(assumed))
    for _ in range(2):  # the weights hang on the parameters only a little
        weights = _Weights(
            view.whitener(parameters[: len(view.prior)], seen.encoders),
            whitener(view, parameters, seen.touches) if seen.touches else np.empty((0, 2, 2)),
        )

        def residuals(at: Array, by: _Weights = weights) -> Array:
            return np.concatenate([*(part.ravel() for part in _white(view, seen, by, at)), at / assumed])

        def derivative(at: Array, by: _Weights = weights) -> Array:
            return np.vstack([_slopes(view, seen, by, at), np.diag(1.0 / assumed)])

        # A first guess may be off by many px: bounded influence brings it in, squares finish it.
        for loss in ("soft_l1", "linear"):
            solution = least_squares(residuals, parameters, jac=derivative, x_scale=assumed, loss=loss)
            parameters = np.asarray(solution.x, np.float64)
    return parameters, weights
