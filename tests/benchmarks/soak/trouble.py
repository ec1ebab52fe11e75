"""What strikes during a soak, and when."""

from __future__ import annotations

import random

PASSING = (
    "camera_lost", "camera_stalled", "picture_frozen", "picture_black", "picture_overexposed", "picture_torn",
    "picture_light", "picture_soft", "picture_moved", "picture_covered", "light_drifting", "pictures_damaged",
    "ledger_unwritable", "bus_corrupt", "bus_noisy", "supply_low", "part_lost", "part_held",
)  # fmt: skip
LATCHING = (
    "bus_timeout", "bus_lost", "servo_overload", "servo_shock", "servo_overheat", "servo_undervoltage",
    "servo_encoder", "servo_rebooted", "motion_timeout",
)  # fmt: skip
DISTURBANCES = ("slip", "knock", "remove", "move", "swap", "hand")


def script(seconds: float, seed: int, faults_an_hour: float) -> str:
    """A script of faults at random moments."""
    random_ = random.Random(seed)
    at, lines = 0.0, list[str]()
    while True:
        at += random_.expovariate(faults_an_hour / 3600.0)
        if at >= seconds:
            break
        name = random_.choice(LATCHING if random_.random() < 0.3 else PASSING)
        lasts = random_.uniform(2.0, 20.0)
        lines.append(f'[[fault]]\nfault = "{name}"\nat_s = {at:.3f}\nduration_s = {lasts:.3f}\n')
    return "\n".join(lines) or '[[fault]]\nfault = "camera_stalled"\nat_s = 5.0\nduration_s = 3.0\n'


def wish(seconds: float, seed: int, disturbances_an_hour: float) -> str:
    """Disturbances at random moments."""
    random_ = random.Random(seed + 1)
    at, words = 0.0, list[str]()
    while True:
        at += random_.expovariate(disturbances_an_hour / 3600.0)
        if at >= seconds:
            return ", ".join(words)
        words.append(f"{random_.choice(DISTURBANCES)}@{at:.2f}")
