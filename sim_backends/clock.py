"""Simulated time behind the `Clock` port: waiting lets the world move on."""

from __future__ import annotations

from sim_backends.plant import Plant


class SimClock:
    """Time of a plant: sleeping and computing advance it, as fast as the machine can.

    Args:
        plant: The world that owns the time.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def now(self) -> float:
        """Seconds of simulated time."""
        return self._plant.now()

    def sleep(self, seconds: float) -> None:
        """Let the world run for `seconds`; zero or less does nothing."""
        if seconds > 0.0:
            self._plant.advance(seconds)

    def charge(self, seconds: float) -> None:
        """Let the world run for as long as a computation is taken to need, s."""
        self.sleep(seconds)
