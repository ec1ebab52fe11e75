"""`controller detect`: find and name what lies in pictures."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track
from rich.table import Table

from controller.calibration.camera import CameraCalibration
from controller.calibration.table import TableCalibration
from controller.cli.output import stderr, stdout
from controller.domain import CellCalibration, Detection, Frame, LocatedObject
from controller.errors import InputError
from controller.localization.locate import locate
from controller.vision.annotate import annotate, annotate_paper
from controller.vision.classes.store import load_classes
from controller.vision.classes.taught import Taught
from controller.vision.detect import detect as find
from controller.vision.models.network import network
from controller.vision.read import read_image
from controller.vision.recipe import Recipe, load_recipe
from controller.vision.report import detection_json

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def detect(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Pictures, or folders of pictures.")],
    recipe: Annotated[str, typer.Option(metavar="precise|paper|FILE", help="How to look.")] = "precise",
    camera: Annotated[Path | None, typer.Option(metavar="FILE", help="Lens, from `calibrate camera --out`.")] = None,
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Table, from `calibrate table --out`.")] = None,
    height_mm: Annotated[float, typer.Option(min=0.0, max=500.0, help="Height of the parts.")] = 20.0,
    background: Annotated[Path | None, typer.Option(metavar="IMAGE", help="Picture of the empty table.")] = None,
    classes: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Name parts by the taught classes of DIR; see `teach`.")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write annotated pictures into DIR, and below it one after every stage."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a picture on stdout.")] = False,
) -> int:
    """Find and name the objects in pictures; with lens and table calibrated, also in millimetres.

    Example: controller detect photos/*.jpg --save found --json
    """
    how = load_recipe(recipe)
    calibration = _calibration(camera, table)
    if how.model is not None:
        # What is wrong with it is no fault of a picture.
        network(how.model)
    taught = Taught(load_classes(classes)) if classes is not None else None
    if taught is not None and not taught.classes:
        raise InputError(f"{classes} holds no taught classes", "teach some: controller teach NAME ... --classes DIR")
    empty = read_image(background) if background is not None else None
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
    if calibration is None and (camera is not None or table is not None):
        raise InputError("--camera and --table belong together", "give both, or neither")
    failed = 0
    files = picture_files(images)
    shown = track(files, "looking", console=stderr(), disable=len(files) < 3 or not sys.stderr.isatty())
    for index, path in enumerate(shown, 1):
        try:
            frame = Frame(index, 0.0, read_image(path), str(path))
            trace: dict[str, NDArray[np.generic]] | None = None if save is None else {}
            result, detections, located = _one(frame, recipe, how, calibration, height_mm, empty, taught, trace)
        except InputError as error:
            failed += 1
            if as_json:
                print(json.dumps({"image": str(path), "error": str(error)}), flush=True)
            print(f"error: {error}", file=sys.stderr)
            continue
        if save is not None:
            _save(save / f"{path.stem}.png", frame, detections, located, how)
            _save_stages(save / "stages" / path.stem, trace or {})
        if as_json:
            print(json.dumps(result), flush=True)
        else:
            _table(result)
    return 1 if failed else 0


def picture_files(images: list[Path]) -> list[Path]:
    """The files named, and the pictures in the folders named; InputError where a folder holds none."""
    files: list[Path] = []
    for path in images:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURES)
            if not inside:
                raise InputError(f"{path} holds no pictures", f"pictures end in {', '.join(PICTURES)}")
            files += inside
        else:
            files.append(path)
    return files


def _calibration(camera: Path | None, table: Path | None) -> CellCalibration | None:
    if camera is None or table is None:
        return None
    lens = CameraCalibration.load(camera)
    plane = TableCalibration.load(table, lens)
    return CellCalibration(plane.calibration_id, lens.camera, plane.T_table_camera, np.eye(4))


def _one(
    frame: Frame,
    name: str,
    recipe: Recipe,
    calibration: CellCalibration | None,
    height_mm: float,
    background: NDArray[np.uint8] | None,
    taught: Taught | None,
    trace: dict[str, NDArray[np.generic]] | None,
) -> tuple[dict[str, Any], tuple[Detection, ...], tuple[LocatedObject, ...]]:
    plane = None
    if calibration is not None:
        if frame.size != calibration.camera.image_size:
            raise InputError(
                f"{frame.source} is {frame.size[0]}x{frame.size[1]} px, the lens was calibrated at "
                f"{calibration.camera.image_size[0]}x{calibration.camera.image_size[1]}",
                "use pictures of the calibrated camera as it was",
            )
        plane = calibration.plane(height_mm / 2)
    if background is not None and background.shape != frame.image.shape:
        raise InputError(f"{frame.source} and the background differ in size", "take both with the same camera")
    detected = find(frame, recipe, plane=plane, background=background, classes=taught, trace=trace)
    located: tuple[LocatedObject, ...] = ()
    if calibration is not None:
        heights = taught.heights if taught is not None else {}
        located = locate(detected.detections, calibration, lambda item: heights.get(item.label, height_mm)).objects
    return detection_json(frame.source, frame, name, detected, located), detected.detections, located


def _save(
    path: Path, frame: Frame, detections: tuple[Detection, ...], located: tuple[LocatedObject, ...], recipe: Recipe
) -> None:
    if recipe.name == "paper":
        picture = annotate_paper(frame.image, detections)
    else:
        picture = annotate(frame.image, detections, located=located)
    if not cv2.imwrite(str(path), picture):
        raise InputError(f"{path} cannot be written", "name a folder that can be written with --save")


def _save_stages(folder: Path, trace: dict[str, NDArray[np.generic]]) -> None:
    """Write the image after every stage, named by it."""
    if trace:
        folder.mkdir(parents=True, exist_ok=True)
    for name, picture in trace.items():
        file = folder / f"{name}.png"
        if not cv2.imwrite(str(file), np.asarray(picture, np.uint8)):
            raise InputError(f"{file} cannot be written", "name a folder that can be written with --save")


def _table(result: dict[str, Any]) -> None:
    objects = result["objects"]
    title = f"{result['image']}: {len(objects)} object{'' if len(objects) == 1 else 's'}"
    metric = any("center_mm" in item for item in objects)
    columns = ["shape", "score", "centre px", "angle deg", "size px", "flags"]
    console = stdout()
    console.print(f"{title}, {result['timing_ms']['total']:.1f} ms", soft_wrap=True)
    if not objects:
        return
    grid = Table(box=None)
    for column in columns[:-1] + (["centre mm", "size mm"] if metric else []) + columns[-1:]:
        grid.add_column(column)
    for item in objects:
        angle = item["angle_deg"]
        row = [
            item["label"],
            f"{item['score']:.2f}",
            _pair(item["center_px"], 2),
            "-" if angle is None else f"{angle:.2f}",
            _pair(item["size_px"], 1),
        ]
        if metric:
            row += [_pair(item.get("center_mm"), 2), _pair(item.get("size_mm"), 2)]
        grid.add_row(*row, ", ".join(item["flags"]))
    console.print(grid)


def _pair(values: list[float] | None, digits: int) -> str:
    return "-" if values is None else " ".join(f"{value:.{digits}f}" for value in values)


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command("detect")(detect)
