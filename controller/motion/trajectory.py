"""When a path is where: time-optimal under joint speed and acceleration limits, then limited in jerk.

The fastest phase rate is found by one backward and one forward pass over a grid of the phase; a moving average
of 40 ms over the phase then bounds the jerk without leaving the path.

Source: reachability analysis of the path parametrisation, Pham and Pham, "A New Approach to Time-Optimal Path
Parameterization Based on Reachability Analysis", IEEE T-RO 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller.domain import ArmDescription, Array, Trajectory
from controller.errors import LimitViolation
from controller.motion import dynamics
from controller.motion.path import Path, speed_limits

PERIOD = 0.01  # s between streamed goals
SMOOTHING = 0.04  # s: the moving average that bounds the jerk at about 2 a / 40 ms
PAYLOAD_BLEND = 0.1  # s over which a gripped part's weight comes to the offset, and goes from it
_GRID_STEP = 0.005  # phase; twice as coarse makes moves 2 % longer, for the samples between decide
_FINE = 0.001  # s
_LONGEST = 60.0  # s at full speed: whole turns of every joint take 4; a path with a cusp never ends
_STRETCHES = 5  # tries to bring the samples under the limits, each nearer
_TOLERANCE = 0.01  # share of a limit that the samples may exceed


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """When the phase of a path is passed, before smoothing.

    Attributes:
        times: ndarray of shape (N,), s.
        phases: ndarray of shape (N,).
        rates: ndarray of shape (N,), phase per second.
    """

    times: Array
    phases: Array
    rates: Array


def acceleration_limits(arm: ArmDescription) -> Array:
    """Planned joint accelerations at most: ndarray of shape (J,), rad/s^2."""
    return np.array([joint.acceleration_limit for joint in arm.joints])


def fastest(path: Path, speeds: Array, accelerations: Array) -> Timing:
    """The time-optimal timing of a path from rest to rest.

    Args:
        path: The path.
        speeds: ndarray of shape (J,), limits, rad/s.
        accelerations: ndarray of shape (J,), limits, rad/s^2.
    """
    count = int(np.clip(path.length / _GRID_STEP, 20, 400)) + 1
    grid = np.linspace(0.0, path.length, count)
    step = grid[1] - grid[0]
    slope = np.asarray(path.spline(grid, 1))
    bend = np.asarray(path.spline(grid, 2))
    size = np.maximum(np.abs(slope), 1e-9)
    # u is the phase's acceleration, x its squared rate: |slope u + bend x| <= a, a strip for every joint.
    ratio = bend / np.where(slope < 0.0, -size, size)
    reach = accelerations / size
    ceiling = ((speeds / size) ** 2).min(axis=1)
    spread = ratio[:, :, None] - ratio[:, None, :]
    room = reach[:, :, None] + reach[:, None, :]
    ceiling = np.minimum(ceiling, (room / np.maximum(spread, 1e-12)).min((1, 2)))
    # Backward: the largest x from which braking still reaches the next point's largest x.
    divisor = 1.0 - 2.0 * step * ratio
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where(divisor > 0.0, 1.0 / divisor, 0.0)
        bias = np.where(divisor > 0.0, 2.0 * step * reach / divisor, np.inf)
    best = ceiling.tolist()
    best[-1] = 0.0
    bounds = _lowest(gain[:-1], bias[:-1], ceiling[1:])
    for k in range(count - 2, -1, -1):
        ahead = best[k + 1]
        for g, b in bounds[k]:
            best[k] = min(ahead * g + b, best[k])
    # Forward: accelerate as hard as the joints allow, never above that.
    best[0] = 0.0
    bounds = _lowest(1.0 - 2.0 * step * ratio[:-1], 2.0 * step * reach[:-1], ceiling[:-1])
    for k in range(count - 1):
        here = best[k]
        for g, b in bounds[k]:
            best[k + 1] = min(here * g + b, best[k + 1])
        best[k + 1] = max(best[k + 1], 0.0)
    rates = np.sqrt(best)
    pairs = rates[1:] + rates[:-1]
    times = np.concatenate([[0.0], np.cumsum(2.0 * step / np.maximum(pairs, 1e-9))])
    return Timing(times, grid, rates)


def _lowest(gains: Array, biases: Array, top: Array) -> list[list[tuple[float, float]]]:
    """Of the lines gain * x + bias, one for each joint, those that may be the lowest somewhere in 0 <= x <= top.

    Gains and biases (N, J), tops (N,). A line that is lowest at both ends is so in between.
    """
    first = biases.argmin(axis=1)
    last = (gains * top[:, None] + biases).argmin(axis=1)
    rows = np.arange(len(gains))
    lines = [[line] for line in zip(gains[rows, first].tolist(), biases[rows, first].tolist(), strict=True)]
    for k in np.flatnonzero(first != last):
        lines[k] = list(zip(gains[k].tolist(), biases[k].tolist(), strict=True))
    return lines


def generate(
    arm: ArmDescription,
    path: Path,
    name: str,
    *,
    speed: float = 1.0,
    joint_offsets: Array | None = None,
    payload: tuple[float, float] = (0.0, 0.0),
) -> Trajectory:
    """A trajectory along a path, from rest to rest, ready to be streamed.

    Args:
        arm: The arm.
        path: The path.
        name: What the move is for.
        speed: Share of the joint speed limits, in (0, 1]; accelerations fall with its square.
        joint_offsets: ndarray of shape (J,), added to every goal, rad.
        payload: Mass at the grasp point (kg) that the arm held before the move, and holds during it; the
            model goes over from one to the other within the first 0.1 s.

    Raises:
        LimitViolation: The path has a cusp, which would take for ever.
    """
    limits = speed_limits(arm), acceleration_limits(arm)
    timing = fastest(path, *limits)
    stretch = 1.0 / speed
    for _ in range(_STRETCHES):
        if timing.times[-1] * stretch * speed > _LONGEST:
            raise LimitViolation(f"{name}: a turn on the spot that no joint can follow", "nothing has moved")
        phase, rate, gain, ticks = _smoothed(timing, stretch)
        index = np.arange(ticks + 1) * round(PERIOD / _FINE)
        positions = np.asarray(path.spline(phase[index]))
        # The grid sees only its own points: what is streamed decides.
        qd = np.diff(positions, axis=0) / PERIOD
        qdd = np.diff(qd, axis=0) / PERIOD
        over = max(float((np.abs(qd) / limits[0]).max()), math.sqrt(float((np.abs(qdd) / limits[1]).max()))) / speed
        if over <= 1.0 + _TOLERANCE:
            break
        stretch *= over
    ahead = np.minimum(index + round(dynamics.lead(PERIOD) / _FINE), len(phase) - 1)
    q, qd, qdd = _along(path, phase[ahead], rate[ahead], gain[ahead])
    speed_now = np.asarray(path.spline(phase[index], 1)) * rate[index][:, None]
    none = np.zeros_like(q)
    blend = np.clip(np.concatenate([ahead, index, index]) * _FINE / PAYLOAD_BLEND, 0.0, 1.0)
    needed, sag, inertia = np.split(
        dynamics.offset(
            arm,
            np.concatenate([q, positions, positions]),
            np.concatenate([qd, none, none]),
            np.concatenate([qdd, none, speed_now]),
            payload[0] + (payload[1] - payload[0]) * blend,
        ),
        3,
    )
    servo_zero = np.zeros(len(limits[0])) if joint_offsets is None else joint_offsets
    goals = q + needed + servo_zero
    resting = positions + sag + servo_zero
    braking = inertia - sag
    for array in (positions, goals, resting, braking):
        array.setflags(write=False)
    return Trajectory(name, PERIOD, positions, goals, resting, braking)


def _along(path: Path, phase: Array, rate: Array, gain: Array) -> tuple[Array, Array, Array]:
    """Joint angles, speeds and accelerations at phases passed at a rate that grows by `gain`."""
    slope = np.asarray(path.spline(phase, 1))
    bend = np.asarray(path.spline(phase, 2))
    q = np.asarray(path.spline(phase))
    return q, slope * rate[:, None], slope * gain[:, None] + bend * (rate * rate)[:, None]


def _smoothed(timing: Timing, stretch: float) -> tuple[Array, Array, Array, int]:
    """Phase, its rate and its acceleration every millisecond after the moving average, and the 100 Hz ticks.

    The time is stretched first; the window is not, so that the jerk stays bounded by it.
    """
    times, rates = timing.times * stretch, timing.rates / stretch
    window = round(SMOOTHING / _FINE)
    ticks = math.ceil((times[-1] + SMOOTHING) / PERIOD - 1e-9)
    # One window of standing still before, and enough after for the look-ahead of the last goal.
    t = np.arange(-window, ticks * round(PERIOD / _FINE) + 1) * _FINE
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    span = times[k + 1] - times[k]
    since = np.clip(t - times[k], 0.0, span)
    rate_gain = (rates[k + 1] - rates[k]) / np.maximum(span, 1e-12)
    phase = timing.phases[k] + since * (rates[k] + 0.5 * rate_gain * since)
    rate = np.where((t <= 0.0) | (t >= times[-1]), 0.0, rates[k] + rate_gain * since)
    area = np.concatenate([[0.0], np.cumsum((phase[1:] + phase[:-1]) * (0.5 * _FINE))])
    mean = (area[window:] - area[:-window]) / SMOOTHING
    mean_rate = (phase[window:] - phase[:-window]) / SMOOTHING
    mean_gain = (rate[window:] - rate[:-window]) / SMOOTHING
    return np.clip(mean, 0.0, timing.phases[-1]), mean_rate, mean_gain, ticks
