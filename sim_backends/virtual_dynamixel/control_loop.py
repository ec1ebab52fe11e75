"""The servo's control loops, turned into what the motor does to the shaft.

The proportional part of the position loop and the motor's back-EMF are handed to the plant as a spring and
a damper, which it integrates with its own step; everything that needs the loop's memory is a bias, renewed
before every physics step.

Source: ROBOTIS e-Manual, `dxl/x/xm430-w350`, "Position PID Gain", "Velocity PI Gain", "Goal PWM". Gain
scaling: PWM = P/128 e + D/16 de + I/65536 sum e, 885 = full voltage. Assumption: the loop runs at 1 kHz on
the unfiltered error; the integral is held within the output limit; the feed-forward gains have no effect.
"""

from __future__ import annotations

import math

from sim_backends.plant import Drive
from sim_backends.virtual_dynamixel.control_table import ControlTable
from sim_backends.virtual_dynamixel.models import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    PWM_FULL,
    PWM_MODE,
    TICKS_PER_RAD,
    VELOCITY_MODE,
    VELOCITY_UNIT,
    ServoModel,
)

LOOP = 0.001
"""s, period of the firmware's loop. Assumption."""


def _clip(value: float, limit: float) -> float:
    return -limit if value < -limit else limit if value > limit else value


class ControlLoop:
    """The loops of one servo; torques and velocities are in register direction.

    Args:
        model: Which servo.
    """

    def __init__(self, model: ServoModel) -> None:
        self._model = model
        self._mode = 3
        self._stiffness = self._per_rate = self._per_sum = 0.0
        self._limit = 0.0
        self._feed = 0.0
        self._velocity_goal = 0.0
        self._speed = 0.0
        self._ramp = math.inf
        self._velocity_p = self._velocity_i = 0.0
        self._sum = 0.0
        self._bias = 0.0
        self._jump = 0.0
        self.needs_steps = False
        """The loop has memory or follows the speed: `step` must be called before every physics step."""

    def tune(self, table: ControlTable, mode: int, supply: float) -> None:
        """Take over gains, goals and limits from the registers, and the supply voltage (V)."""
        model = self._model
        per_pwm = model.stall_torque * supply / model.voltage / PWM_FULL
        get = table.get
        self._mode = mode
        limit = get("PWM_Limit") if mode == PWM_MODE else min(abs(get("Goal_PWM")), get("PWM_Limit"))
        self._limit = limit * per_pwm
        self._stiffness = self._per_rate = self._per_sum = self._feed = 0.0
        self.needs_steps = mode in (VELOCITY_MODE, CURRENT_MODE)
        if mode == PWM_MODE:
            self._feed = get("Goal_PWM") * per_pwm
        elif mode == CURRENT_MODE:
            self._feed = get("Goal_Current") * model.current_unit * model.torque_constant
        elif mode == VELOCITY_MODE:
            self._velocity_goal = get("Goal_Velocity") * VELOCITY_UNIT
            ramp = get("Profile_Acceleration") * 214.577 / 3600 * 2 * math.pi
            self._ramp = ramp if ramp else math.inf
            self._velocity_p = get("Velocity_P_Gain") / 128 * per_pwm / VELOCITY_UNIT
            self._velocity_i = get("Velocity_I_Gain") / 65536 * per_pwm / VELOCITY_UNIT / LOOP
        else:
            if mode == CURRENT_POSITION_MODE:
                holding = abs(get("Goal_Current")) * model.current_unit * model.torque_constant
                self._limit = min(self._limit, holding)
            self._stiffness = get("Position_P_Gain") / 128 * per_pwm * TICKS_PER_RAD
            self._per_rate = get("Position_D_Gain") / 16 * per_pwm * TICKS_PER_RAD * LOOP
            self._per_sum = get("Position_I_Gain") / 65536 * per_pwm * TICKS_PER_RAD / LOOP
            self.needs_steps = self._per_rate != 0.0 or self._per_sum != 0.0
            if not self.needs_steps:
                self._bias = 0.0

    def reset(self) -> None:
        """Forget the past: torque has just come on."""
        self._sum = self._bias = self._jump = self._speed = 0.0

    def jump(self, ticks: float) -> None:
        """The goal has jumped; the derivative sees it in one loop."""
        self._jump += ticks / TICKS_PER_RAD

    def step(self, error: float, goal_velocity: float, velocity: float, dt: float) -> None:
        """Renew the bias.

        Args:
            error: Goal minus present position, ticks.
            goal_velocity: Of the profile, ticks/s.
            velocity: Of the shaft, rad/s.
            dt: Time until the next call, s.
        """
        if self._mode == CURRENT_MODE:
            # The current loop makes up for the back-EMF, which the plant subtracts.
            self._bias = self._feed + self._model.back_emf * velocity
        elif self._mode == VELOCITY_MODE:
            self._speed += _clip(self._velocity_goal - self._speed, self._ramp * dt)
            lag = self._speed - velocity
            self._sum = _clip(self._sum + self._velocity_i * lag * dt, self._limit)
            self._bias = self._velocity_p * lag + self._sum
        else:
            distance = error / TICKS_PER_RAD
            spring = self._stiffness * distance
            self._sum = _clip(self._sum + self._per_sum * distance * dt, self._limit)
            steady = spring + self._sum + self._per_rate * (goal_velocity / TICKS_PER_RAD - velocity)
            torque = _clip(steady, self._limit)
            if self._jump:
                kick = _clip(steady + self._per_rate * self._jump / LOOP, self._limit)
                share = min(1.0, LOOP / dt)
                torque += share * (kick - torque)
                self._jump = 0.0
            self._bias = torque - spring

    def drive(self, target: float, sign: float) -> Drive:
        """What the motor does now.

        Args:
            target: Goal of the position loop, rad of the bare shaft.
            sign: -1 where Drive_Mode reverses the direction.
        """
        back_emf = self._model.back_emf
        if self._mode == PWM_MODE:
            return Drive(0.0, 0.0, back_emf, sign * self._feed, self._limit)
        if self._mode in (CURRENT_MODE, VELOCITY_MODE):
            return Drive(0.0, 0.0, back_emf, sign * self._bias, self._limit)
        return Drive(target, self._stiffness, back_emf, sign * self._bias, self._limit)
