"""Live capture of calibration views in a terminal: the guide's advice as it changes, a line for every view taken."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2

from controller.backends import BackendOptions, Level, PaintedTable
from controller.calibration.boards import Board
from controller.calibration.capture import Capture, Progress, Seen
from controller.calibration.guided import SETTLE, board_pose_for, wanted_views
from controller.cli.camera import open_camera
from controller.cli.config import default_config
from controller.config.arm import load_arm
from controller.config.cell import load_cell
from controller.errors import CalibrationPoorFit, InputError
from controller.ports import Camera, Clock

#: Pictures a second that are looked at: finding a board takes a good part of the rest.
_PERIOD = 0.2
#: A capture in which nothing new comes for so long has been left alone, s.
_PATIENCE = 120.0


def capture_live(
    config: Path | None, board: Board, *, device: str | None, sim: bool, seed: int, level: Level, save: Path | None
) -> Capture:
    """Look until enough views are taken. Moves no arm; blocks.

    Args:
        config: With the camera's settings.
        board: What is shown.
        device: The camera, when it is not the configuration's.
        sim: A simulated camera, and hands that show the board to it.
        seed: Of the simulated cell.
        level: Of the simulated cell.
        save: Folder for the pictures of the views.

    Raises:
        CalibrationPoorFit: Nothing new has come for two minutes.
        InputError: The folder cannot be written.
        CameraError: The camera failed.
    """
    capture = Capture(board)
    if sim:
        cell = load_cell(config or default_config())
        table = PaintedTable(cell, load_arm(cell.arm.description), BackendOptions(Path(), seed=seed, level=level))
        progress = _look(capture, table.camera, table.clock, _hands(table, board))
    else:
        with open_camera(config, device, False) as (camera, clock):
            progress = _look(capture, camera, clock, lambda progress: True)
    if not progress.done:
        raise CalibrationPoorFit(
            f"only {progress.views} views were taken, and then nothing new came", f"begin again: {progress.advice}"
        )
    if save is not None:
        _keep(capture, save)
    return capture


def _look(capture: Capture, camera: Camera, clock: Clock, go_on: Callable[[Progress], bool]) -> Progress:
    """Offer pictures until it is enough, nothing comes any more, or nobody shows anything more."""
    said, last_new = "", clock.now()
    while True:
        progress = capture.offer(camera.capture(clock.now()).image)
        if progress.seen is Seen.TAKEN:
            last_new = clock.now()
        line = _line(progress)
        if line != said:
            print(line, file=sys.stderr, flush=True)
            said = line
        if progress.done or clock.now() - last_new > _PATIENCE or not go_on(progress):
            return progress
        clock.sleep(_PERIOD)


def _line(progress: Progress) -> str:
    tilts = "/".join(str(count) for count in progress.tilts)
    return f"{progress.views:2d} views, {progress.covered:4.0%} covered, tilts {tilts}: {progress.advice}"


def _hands(table: PaintedTable, board: Board) -> Callable[[Progress], bool]:
    """Simulated hands: the next view of the guide whenever the last one was taken or will not be."""
    fine = board.pitch / 40
    print_ = board.draw(fine)
    size = table.camera.capture(table.clock.now()).size
    patience = 0

    def show_next() -> bool:
        nonlocal patience
        patience = 0
        view = next(views, None)
        if view is None:
            return False
        table.presenter.hold(print_, fine, board_pose_for(view, board, size))
        table.clock.sleep(SETTLE)
        return True

    views = iter(wanted_views())
    show_next()

    def go_on(progress: Progress) -> bool:
        nonlocal patience
        patience += 1
        return show_next() if progress.seen is Seen.TAKEN or patience > 2 else True

    return go_on


def _keep(capture: Capture, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})", "name another folder") from error
    for (name, _), image in zip(capture.taken, capture.images, strict=True):
        path = folder / f"{name.replace(' ', '-')}.png"
        if not cv2.imwrite(str(path), image):
            raise InputError(f"{path}: cannot be written", "name another folder")
