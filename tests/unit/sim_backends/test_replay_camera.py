from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.errors import CameraEnded, CameraLost, FrameStale, InputError
from sim_backends.replay_camera import ReplayCamera, natural_key, read_picture
from sim_backends.virtual_clock import VirtualClock


def write(path: Path, value: int, size: tuple[int, int] = (16, 12)) -> Path:
    """A picture with one value everywhere, by which it can be told from the others."""
    assert cv2.imwrite(str(path), np.full((size[1], size[0], 3), value, np.uint8))
    return path


def values(camera: ReplayCamera, count: int) -> list[int]:
    return [int(camera.capture(0.0).image[0, 0, 0]) for _ in range(count)]


def test_pictures_come_in_natural_order_and_then_end(tmp_path: Path) -> None:
    for name, value in {"part10.png": 30, "part2.png": 20, "part1.PNG": 10, "Part20.bmp": 40}.items():
        write(tmp_path / name, value)
    (tmp_path / "notes.txt").write_text("not a picture", encoding="ascii")
    write(tmp_path / ".hidden.png", 99)
    camera = ReplayCamera(tmp_path, VirtualClock())
    camera.open()
    assert values(camera, 4) == [10, 20, 30, 40]
    with pytest.raises(CameraEnded, match="after 4"):
        camera.capture(0.0)
    camera.close()


def test_pictures_named_one_by_one_keep_their_order(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{name}.png", value) for name, value in (("b", 2), ("a", 1))]
    camera = ReplayCamera(paths, VirtualClock())
    camera.open()
    assert values(camera, 2) == [2, 1]
    camera.close()


def test_opening_again_goes_on_with_the_next(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 5)
    write(tmp_path / "b.png", 6)
    camera = ReplayCamera(tmp_path, VirtualClock())
    for value in (5, 6):
        camera.open()
        assert values(camera, 1) == [value]
        camera.close()
    camera.open()
    with pytest.raises(CameraEnded):
        camera.capture(0.0)


def test_a_frame_carries_its_file_number_and_time(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 5)
    write(tmp_path / "b.png", 6)
    clock = VirtualClock(10.0)
    camera = ReplayCamera(tmp_path, clock, period=0.25)
    camera.open()
    first, second = camera.capture(0.0), camera.capture(11.0)
    assert (first.frame_id, first.source, first.captured_at) == (1, str(tmp_path / "a.png"), 10.25)
    assert (second.frame_id, second.captured_at, clock.now()) == (2, 11.25, 11.25)
    assert not first.image.flags.writeable
    camera.close()


def test_a_picture_not_due_in_time_is_kept(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 5)
    clock = VirtualClock(10.0)
    camera = ReplayCamera(tmp_path, clock)
    camera.open()
    with pytest.raises(FrameStale):
        camera.capture(20.0, timeout=3.0)
    assert (clock.now(), camera.remaining) == (13.0, 1)
    camera.close()


def test_a_closed_camera_says_so(tmp_path: Path) -> None:
    camera = ReplayCamera(tmp_path, VirtualClock())
    camera.close()
    with pytest.raises(CameraLost, match="not open"):
        camera.capture(0.0)


def test_an_empty_or_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pictures in this folder"):
        ReplayCamera(tmp_path, VirtualClock()).open()
    with pytest.raises(InputError, match="no such file or folder"):
        ReplayCamera(tmp_path / "none", VirtualClock()).open()
    with pytest.raises(InputError, match="no such file"):
        ReplayCamera([tmp_path / "none.png"], VirtualClock()).open()
    with pytest.raises(InputError, match="no pictures"):
        ReplayCamera([], VirtualClock()).open()


@pytest.mark.parametrize("content", [b"", b"just a text\n" * 20])
def test_a_file_that_only_is_named_like_a_picture_is_refused_before_the_run(tmp_path: Path, content: bytes) -> None:
    write(tmp_path / "a.png", 5)
    (tmp_path / "b.png").write_bytes(content)
    with pytest.raises(InputError, match=r"b\.png: not a picture"):
        ReplayCamera(tmp_path, VirtualClock()).open()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".ppm"])
def test_a_picture_cut_short_is_refused(tmp_path: Path, suffix: str) -> None:
    texture = np.random.default_rng(1).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    ok, data = cv2.imencode(suffix, texture)
    assert ok
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(data.tobytes()[: len(data) * 3 // 5])
    camera = ReplayCamera(tmp_path, VirtualClock())
    camera.open()
    with pytest.raises(InputError, match="cut short"):
        camera.capture(0.0)
    camera.close()
    path.write_bytes(data.tobytes())
    assert read_picture(path).shape == (60, 80, 3)


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 5, (16, 12))
    write(tmp_path / "b.png", 5, (12, 16))
    camera = ReplayCamera(tmp_path, VirtualClock())
    camera.open()
    camera.capture(0.0)
    with pytest.raises(InputError, match=r"b\.png: 12x16 pixels.*16x12"):
        camera.capture(0.0)
    camera.close()


def test_grey_and_deep_pictures_become_eight_bit_colour(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 6), 0x8000, np.uint16))
    image = read_picture(tmp_path / "deep.png")
    assert (image.shape, str(image.dtype), int(image[0, 0, 0])) == ((4, 6, 3), "uint8", 128)


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=2, max_size=6), st.text("ab-_. ", max_size=4))
def test_numbers_in_names_sort_by_value(numbers: list[int], stem: str) -> None:
    paths = [Path(f"x{stem}{number}.png") for number in numbers]
    assert sorted(paths, key=natural_key) == [Path(f"x{stem}{number}.png") for number in sorted(numbers)]


@given(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="/\0"), min_size=1), min_size=2, max_size=5))
def test_any_names_can_be_sorted(names: list[str]) -> None:
    sorted((Path(f"{name}.png") for name in names), key=natural_key)
