"""Reading pictures, annotating them, and the JSON of detections."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.domain import LocatedObject, Shape
from controller.errors import InputError
from controller.vision.annotate import annotate, annotate_paper
from controller.vision.detect import detect
from controller.vision.read import read_image
from controller.vision.recipe import load_recipe
from controller.vision.report import detection_json
from tests.unit.vision.pictures import at, corners, frame, paint

PICTURE = paint([(at(corners(Shape.SQUARE, 60.0, 0.2), 160, 120), (70.0, 60.0, 200.0))])


def write(path: Path, image: NDArray[np.generic]) -> Path:
    assert cv2.imwrite(str(path), np.asarray(image))
    return path


def test_colour_comes_back_as_it_was(tmp_path: Path) -> None:
    assert np.array_equal(read_image(write(tmp_path / "a.png", PICTURE)), PICTURE)


def test_gray_sixteen_bit_and_alpha_become_bgr(tmp_path: Path) -> None:
    gray = PICTURE[:, :, 1]
    assert np.array_equal(read_image(write(tmp_path / "g.png", gray)), np.repeat(gray[:, :, None], 3, axis=2))
    deep = gray.astype(np.uint16) * 257
    assert np.array_equal(read_image(write(tmp_path / "d.png", deep))[:, :, 0], gray)
    alpha = np.dstack([PICTURE, np.full(gray.shape, 0, np.uint8)])
    assert read_image(write(tmp_path / "t.png", alpha)).min() == 255


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_picture_cut_short_is_refused(suffix: str, share: float, tmp_path: Path) -> None:
    whole = write(tmp_path / f"whole{suffix}", PICTURE).read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="cut short"):
        read_image(cut)


def test_bytes_after_the_end_do_not_matter(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", PICTURE)
    path.write_bytes(path.read_bytes() + b"\0" * 100)
    assert read_image(path).shape == PICTURE.shape


@pytest.mark.parametrize(
    ("content", "named"), [(b"", "empty"), (b"hello, this is text", "not a picture"), (None, "cannot be read")]
)
def test_what_is_no_picture_says_why(content: bytes | None, named: str, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=named) as error:
        read_image(path)
    assert error.value.remedy


def test_a_folder_is_no_picture(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder"):
        read_image(tmp_path)


@pytest.mark.parametrize("scale", [0.5, 1.0, 8.0])
def test_annotated_pictures_are_wide_enough_to_read(scale: float) -> None:
    image = np.asarray(cv2.resize(PICTURE, None, fx=scale, fy=scale), np.uint8)
    detected = detect(frame(image), load_recipe("precise"))
    out = annotate(image, detected.detections)
    assert out.shape[1] >= 960
    assert out.shape[1] % image.shape[1] == 0
    # The legend is added below; the picture itself is not squeezed.
    assert out.shape[0] > image.shape[0] * out.shape[1] // image.shape[1]
    assert image.max() == np.asarray(cv2.resize(PICTURE, None, fx=scale, fy=scale)).max()


def test_the_papers_figure_has_a_red_box_and_centre() -> None:
    detected = detect(frame(PICTURE), load_recipe("paper"))
    item = max(detected.detections, key=lambda d: d.area_px)
    out = annotate_paper(PICTURE, [item])
    x, y = (round(v) for v in item.center_px)
    assert tuple(out[y, x]) == (0, 0, 255)
    assert tuple(out[round(item.bbox_px[1]), x]) == (0, 0, 255)


def test_json_has_every_promised_field() -> None:
    seen = frame(PICTURE)
    detected = detect(seen, load_recipe("precise"))
    (item,) = detected.detections
    place = LocatedObject(item, (1.0, 2.0), 0.5, (40.0, 40.0), 20.0, item.outline_px, 0.2, "c")
    out = json.loads(json.dumps(detection_json("a.png", seen, "precise", detected, [place]), allow_nan=False))
    assert out["image"] == "a.png"
    assert out["size"] == [320, 240]
    assert out["timing_ms"]["total"] > 0.0
    (thing,) = out["objects"]
    assert thing["shape"] == "square"
    assert 0.0 <= thing["angle_deg"] < 90.0
    assert set(thing["descriptors"]) == {"extent", "compactness", "side_difference"}
    assert thing["angle_table_deg"] == pytest.approx(math.degrees(0.5), abs=1e-3)
    assert thing["center_mm"] == [1.0, 2.0]
    # The outline runs counter-clockwise as displayed: with y down its signed area is negative.
    u, v = np.array(thing["outline_px"]).T
    assert np.sum(u * np.roll(v, -1) - np.roll(u, -1) * v) < 0.0


def test_json_without_calibration_has_no_millimetres() -> None:
    seen = frame(PICTURE)
    out = detection_json("a.png", seen, "precise", detect(seen, load_recipe("precise")))
    assert not [key for key in out["objects"][0] if key.endswith("_mm")]
