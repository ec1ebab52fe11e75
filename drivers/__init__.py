"""Drivers of real hardware, each behind a port of `controller.ports`."""
