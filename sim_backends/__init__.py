"""Simulated cameras, arms, clocks and the physics cell; they swap in for hardware behind the same ports."""
