"""What cameras are plugged in, from the links and names the system keeps; opens nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class CameraListing:
    """One video device that gives pictures.

    Attributes:
        device: Its node, e.g. `/dev/video0`; may change with every plug.
        name: What it calls itself.
        stable: Links that keep their name: below by-id where the camera has a serial number, else by-path.
    """

    device: str
    name: str
    stable: tuple[str, ...]


def list_cameras(root: Path = Path("/")) -> tuple[CameraListing, ...]:
    """Video capture devices in order of their numbers; empty where the system has none or is not Linux.

    Args:
        root: Root of the file system.
    """
    nodes = sorted((root / "sys/class/video4linux").glob("video*"), key=_number)
    links = [
        link
        for kind in ("by-id", "by-path")
        for link in sorted((root / "dev/v4l" / kind).glob("*"))
    ]
    found = []
    for node in nodes:
        # A camera has further nodes, for metadata: only the first of a device gives pictures.
        if _text(node / "index") not in ("0", ""):
            continue
        device = root / "dev" / node.name
        stable = tuple(_outside(link, root) for link in links if link.resolve().name == node.name)
        found.append(CameraListing(_outside(device, root), _text(node / "name"), stable))
    return tuple(found)


def _number(node: Path) -> int:
    digits = node.name.removeprefix("video")
    return int(digits) if digits.isdecimal() else -1


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _outside(path: Path, root: Path) -> str:
    """The path as it is called on the system whose root this is."""
    return "/" + str(path.relative_to(root))
