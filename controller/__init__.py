"""The sorting controller's core: it knows no serial port, no video device and no physics engine."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("sorting-controller")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+unknown"
