"""`calibrate camera|table` as their user meets them: bad input is named, and leaves nothing half-written."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.calibration.board_spec import parse_board
from controller.calibration.guided import board_pose_for, wanted_views
from controller.cli import camera as room
from controller.cli import execute
from controller.domain import Frame
from sim_backends.virtual_clock import VirtualClock
from tests.unit.calibration.scene import paint, small_lens

LENS = small_lens()
SPEC = "charuco:10x7:28:21:DICT_5X5_100"
BOARD = parse_board(SPEC)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven good views."""
    folder = tmp_path_factory.mktemp("views")
    print_ = BOARD.draw(0.7)
    for index, wanted in enumerate(wanted_views()[::2]):
        image = paint(print_, 0.7, board_pose_for(wanted, BOARD, LENS.image_size), LENS, samples=2)
        cv2.imwrite(str(folder / f"{index:02d}.png"), image)
    return folder


def calibrate(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = execute(["calibrate", "camera", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_lens_is_calibrated_and_its_coverage_drawn(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.json"
    broken, other, empty = (tmp_path / name for name in ("broken.png", "other.png", "empty.png"))
    broken.write_bytes(b"no picture")
    cv2.imwrite(str(other), np.full((200, 200), 128, np.uint8))
    cv2.imwrite(str(empty), np.full((360, 640), 128, np.uint8))
    code, said, warned = calibrate(
        capsys, *sorted(views.glob("*.png")), broken, other, empty, "--board", SPEC, "--out", out, "--json"
    )
    assert code == 0, warned
    found = json.loads(said)
    assert found["views_used"] == 11
    reasons = {Path(item["image"]).name: item["reason"] for item in found["views_rejected"]}
    assert "200x200" in reasons["other.png"]
    assert "seen" in reasons["empty.png"]
    assert "decoded" in reasons["broken.png"]
    assert "broken.png" in warned
    written = json.loads(out.read_text())
    assert written["calibration_id"] == found["calibration_id"]
    assert written["views_rejected"] == found["views_rejected"]
    assert cv2.imread(str(tmp_path / "camera.png")) is not None


@pytest.mark.parametrize(
    ("choice", "board", "said"),
    [
        (slice(0, 3), SPEC, "only 3 of 3 pictures show"),
        (slice(0, 11), "charuco:8x5:28:21:DICT_4X4_50", "check the board's SPEC"),
        (slice(0, 11), "circles:9x6:25", "check the board's SPEC"),
        (slice(0, 11), "chess:9x6", "is not known"),
        (slice(0, 11), "charuco:10x7:28:35:DICT_5X5_100", "do not fit"),
    ],
)
def test_what_cannot_be_calibrated_is_said_and_nothing_written(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], choice: slice, board: str, said: str
) -> None:
    out = tmp_path / "new" / "camera.json"
    code, _, error = calibrate(capsys, *sorted(views.glob("*.png"))[choice], "--board", board, "--out", out)
    assert code == 1
    assert said in error
    assert not out.parent.exists()


def test_the_same_view_again_and_again_is_refused(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.json"
    code, _, error = calibrate(capsys, *[views / "03.png"] * 12, "--board", SPEC, "--out", out)
    assert code == 1
    assert "not pinned" in error
    assert not list(tmp_path.iterdir())


def test_two_sizes_half_and_half_leave_the_rest_named(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = sorted(views.glob("*.png"))
    for path in pictures[:5]:
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(tmp_path / path.name), cv2.resize(image, (320, 180)))
    code, said, _ = calibrate(
        capsys, *pictures[5:], *sorted(tmp_path.glob("*.png")), "--board", SPEC, "--json"
    )
    assert code == 0
    rejected = json.loads(said)["views_rejected"]
    assert len(rejected) == 5
    assert all("320x180" in item["reason"] for item in rejected)


def test_an_earlier_file_survives_a_calibration_that_fails(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.json"
    out.write_text("kept")
    code, _, _ = calibrate(capsys, views / "00.png", "--board", SPEC, "--out", out)
    assert code == 1
    assert out.read_text() == "kept"


def test_a_live_capture_needs_a_camera(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, error = calibrate(capsys, "--board", SPEC)
    assert code == 1
    assert "--sim" in error


def test_a_robot_and_its_camera_from_files(shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared / "data" / "rosi_charuco_robot"
    spec = "charuco:5x7:36.195:18.256:DICT_6X6_250"
    pictures = sorted(folder.glob("charuco_*.jpg"))
    code, _, said = calibrate(capsys, *pictures, "--board", spec, "--out", tmp_path / "lens.json", "--json")
    assert code == 0, said
    arguments = [*pictures, "--board", spec, "--camera", tmp_path / "lens.json", "--json"]
    assert execute(["calibrate", "robot", *map(str, arguments)]) == 0
    found = json.loads(capsys.readouterr().out)
    # The source's own test asks for 1.5 px, 5 mm and 1.5 degrees.
    assert found["rms_px"] < 1.5
    assert found["apart_mm"]["mean"] < 3.0
    assert found["apart_deg"]["mean"] < 0.5
    assert len(found["T_base_camera"]) == 4


def test_a_robot_pose_that_makes_no_sense_is_named(
    views: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lens = tmp_path / "lens.json"
    assert calibrate(capsys, *sorted(views.glob("*.png")), "--board", SPEC, "--out", lens)[0] == 0
    assert execute(["calibrate", "robot", str(views / "00.png"), "--board", SPEC, "--camera", str(lens)]) == 1
    assert "00_pose.yaml: cannot be read" in capsys.readouterr().err


class Looking:
    """A camera over a table with the board on it."""

    def __init__(self) -> None:
        tilted = wanted_views()[4]
        self.image = paint(BOARD.draw(0.7), 0.7, board_pose_for(tilted, BOARD, LENS.image_size), LENS, samples=2)
        self.pictures = 0

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, after: float, timeout: float = 2.0) -> Frame:
        self.pictures += 1
        return Frame(self.pictures, after, np.dstack([self.image] * 3), "/dev/video0")


def test_the_table_is_measured_from_pictures_taken_now(
    views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, out, looking = tmp_path / "lens.json", tmp_path / "table.json", Looking()
    assert calibrate(capsys, *sorted(views.glob("*.png")), "--board", SPEC, "--out", lens)[0] == 0
    monkeypatch.setattr(room, "lone_camera", lambda config, device: (looking, VirtualClock()))
    arguments = ["--camera", str(lens), "--board", SPEC, "--device", "/dev/video0", "--out", str(out)]
    assert execute(["calibrate", "table", *arguments]) == 0
    assert looking.pictures == 10
    assert json.loads(out.read_text())["frames"] == 10
    assert {"made_at", "software"} <= set(json.loads(out.read_text())["provenance"])
