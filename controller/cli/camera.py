"""`controller camera`: what is plugged in, one picture, and a live figure to focus by."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from controller.backends import BackendOptions, PaintedTable, lone_camera, plugged_in
from controller.cli.config import default_config
from controller.cli.output import stdout
from controller.config.arm import load_arm
from controller.config.cell import CellConfig, load_cell
from controller.errors import CameraLost, InputError
from controller.ports import Camera, Clock

group = typer.Typer(help="See what is plugged in, take a picture, focus.", no_args_is_help=True)

ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="The cell's TOML file.")]
Device = Annotated[
    str | None, typer.Option(metavar="PATH", help="The camera; else the configuration's, else the first plugged in.")
]
Sim = Annotated[bool, typer.Option("--sim", help="The simulated camera over an empty table.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object a line on stdout.")]

_NAME = "camera"
_NONE = "plug one in, and see that the user is in the group `video`"
_EVERY = 1.0  # s between two figures
_BAR = 40


@group.command("list")
def list_(as_json: AsJson = False) -> None:
    """Cameras that are plugged in: device, name, and the links that keep their name.

    Example: controller camera list
    """
    found = plugged_in()
    if not found:
        raise CameraLost(_NAME, "list", "none is plugged in", _NONE)
    if as_json:
        for camera in found:
            print(json.dumps(asdict(camera)))
        return
    grid = Table("device", "name", "for the configuration", box=None, pad_edge=False)
    for camera in found:
        grid.add_row(camera.device, camera.name, "\n".join(camera.stable) or camera.device)
    stdout().print(grid)


@group.command()
def snapshot(
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write the picture, .png or .jpg.")],
    config: ConfigFile = None,
    device: Device = None,
    sim: Sim = False,
    as_json: AsJson = False,
) -> None:
    """One picture, taken with the configuration's size and settings.

    Example: controller camera snapshot table.png --config cell.toml
    """
    with open_camera(config, device, sim) as (camera, clock):
        frame = camera.capture(clock.now(), timeout=5.0)
    try:
        written = cv2.imwrite(str(out), frame.image)
    except cv2.error:
        written = False
    if not written:
        raise InputError(f"{out}: cannot be written", "name a .png or .jpg file in a folder you may write to")
    width, height = frame.size
    sharp = round(sharpness(frame.image), 2)
    if as_json:
        print(json.dumps({"image": str(out), "size": [width, height], "camera": frame.source, "sharpness": sharp}))
    else:
        print(f"written to {out}: {width} x {height}, sharpness {sharp:g}")


@group.command()
def focus(
    config: ConfigFile = None,
    device: Device = None,
    sim: Sim = False,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many figures.")] = None,
    as_json: AsJson = False,
) -> None:
    """A figure of sharpness every second, and the best so far: turn the lens until it is at its best.

    Example: controller camera focus --config cell.toml

    Put something with fine print or edges where the parts will lie. Ends with Ctrl-C or after --frames.
    """
    best, count = 0.0, 0
    with open_camera(config, device, sim) as (camera, clock):
        began = clock.now()
        while frames is None or count < frames:
            image = camera.capture(clock.now(), timeout=5.0).image
            sharp = sharpness(image)
            best, count = max(best, sharp), count + 1
            if as_json:
                figures = {"at_s": round(clock.now() - began, 3), "sharpness": round(sharp, 3), "best": round(best, 3)}
                print(json.dumps(figures), flush=True)
            else:
                share = sharp / best if best else 0.0
                print(f"{sharp:8.2f}  best {best:8.2f}  {'#' * round(_BAR * share):<{_BAR}} {share:4.0%}", flush=True)
            if frames is None or count < frames:
                clock.sleep(max(0.0, began + count * _EVERY - clock.now()))


def sharpness(image: NDArray[np.uint8]) -> float:
    """How sharp the middle half of a picture is: its gradients' root mean square a pixel, per cent of its brightness.

    Light alone does not change it; noise adds to it, so that it is to be compared within one scene only.
    Source: the Tenengrad measure, e.g. Pertuz et al., Analysis of focus measure operators, 2013.
    """
    height, width = image.shape[:2]
    middle = image[height // 4 : height - height // 4, width // 4 : width - width // 4]
    gray = cv2.cvtColor(middle, cv2.COLOR_BGR2GRAY).astype(np.float32)
    x, y = (cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    return 100.0 * float(np.sqrt(np.mean(x * x + y * y))) / max(float(gray.mean()), 1.0)


@contextmanager
def open_camera(config: Path | None, device: str | None, sim: bool) -> Iterator[tuple[Camera, Clock]]:
    """A camera, open: the named one, the configuration's, or the first plugged in; or the simulated one."""
    cell = load_cell(config or default_config())
    if sim:
        table = PaintedTable(cell, load_arm(cell.arm.description), BackendOptions(Path()))
        yield table.camera, table.clock
        return
    camera, clock = lone_camera(cell, device or _device(config, cell))
    camera.open()
    try:
        yield camera, clock
    finally:
        camera.close()


def _device(config: Path | None, cell: CellConfig) -> str:
    """The configured camera, else the first there is."""
    if config is not None:
        return cell.camera.device
    found = plugged_in()
    if not found:
        raise CameraLost(_NAME, "open", "none is plugged in", _NONE)
    return found[0].device


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.add_typer(group, name="camera")
