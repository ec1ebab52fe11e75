"""Annotated pictures against what is found in them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.domain import Descriptors, Detection, Frame, Shape
from controller.errors import InputError
from controller.insight.images_evaluation import (
    Annotated,
    Box,
    annotated_pictures,
    compare,
    evaluate_images,
    mistakes,
    overlap,
    page,
    summary,
    worst,
)
from controller.vision.recipe import load_recipe

IMAGE = np.zeros((100, 100, 3), np.uint8)


def marked(box: Box, shape: Shape = Shape.SQUARE, *flags: str) -> Annotated:
    return Annotated(shape, (box[0] + box[2] / 2, box[1] + box[3] / 2), box, frozenset(flags), "")


def found(box: Box, shape: Shape = Shape.SQUARE, *flags: str) -> Detection:
    x, y, w, h = box
    corners = np.array([[x, y], [x, y + h], [x + w, y + h], [x + w, y]], np.float64)
    center, nothing = (x + w / 2, y + h / 2), Descriptors(1.0, 1.27, 0.0)
    frame = Frame(1, 0.0, IMAGE)
    return Detection(frame, shape, 1.0, corners, center, (w, h), 0.0, w * h, box, nothing, "", frozenset(flags))


def test_mistakes_that_repeat_are_said_once() -> None:
    objects = [marked((0, 0, 20, 20)), marked((40, 0, 20, 20)), marked((0, 60, 20, 20), Shape.CIRCLE)]
    detections = (found((0, 0, 20, 20), Shape.OTHER), found((40, 0, 20, 20), Shape.OTHER))
    told = mistakes(compare("a", IMAGE, objects, detections))
    assert told == "square taken for other (2); circle missed"
    assert mistakes(compare("a", IMAGE, objects[:1], (found((0, 0, 20, 20)),))) == ""


def test_overlap() -> None:
    assert overlap((0, 0, 10, 10), (0, 0, 10, 10)) == 1.0
    assert overlap((0, 0, 10, 10), (5, 0, 10, 10)) == pytest.approx(1 / 3)
    assert overlap((0, 0, 10, 10), (10, 0, 10, 10)) == 0.0


def test_every_object_is_found_missed_or_made_up_once() -> None:
    objects = [marked((0, 0, 20, 20)), marked((40, 0, 20, 20), Shape.CIRCLE), marked((0, 60, 20, 20))]
    detections = (found((1, 0, 20, 20)), found((40, 2, 20, 20), Shape.OTHER), found((70, 70, 20, 20)))
    picture = compare("a", IMAGE, objects, detections)
    assert [(m.true.shape, m.found.shape) for m in picture.wrong] == [(Shape.CIRCLE, Shape.OTHER)]
    assert picture.missed == [objects[2]]
    assert picture.false == [detections[2]]
    assert [m.center_error for m in picture.matches] == [1.0, 2.0]
    assert [m.box_error for m in picture.matches] == [1.0, 2.0]
    figures = summary(Path("x"), "precise", [picture])
    assert (figures["objects"], figures["found"], figures["right"], figures["missed"], figures["false"]) == (
        3,
        2,
        1,
        1,
        1,
    )
    assert figures["confusion"] == {
        "circle": {"other": 1}, "nothing": {"square": 1}, "square": {"missed": 1, "square": 1},
    }  # fmt: skip


def test_two_detections_of_one_object_are_one_too_many() -> None:
    picture = compare("a", IMAGE, [marked((0, 0, 20, 20))], (found((0, 0, 20, 20)), found((1, 1, 20, 20))))
    assert len(picture.matches) == 1
    assert picture.matches[0].center_error == 0.0
    assert len(picture.false) == 1


def test_what_the_border_cuts_is_neither_missed_nor_made_up() -> None:
    picture = compare(
        "a",
        IMAGE,
        [marked((0, 0, 20, 20), Shape.OTHER, "cut_by_border")],
        (found((80, 80, 20, 20), Shape.OTHER, "cut_by_border"),),
    )
    assert (picture.errors, picture.excused) == (0, 2)


def folder_with(tmp_path: Path, objects: object) -> Path:
    image = np.full((240, 320, 3), 200, np.uint8)
    cv2.rectangle(image, (60, 60), (119, 119), (40, 40, 160), -1)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    entry = {"file": "a.png", "size": [320, 240], "objects": objects}
    (tmp_path / "annotations.json").write_text(json.dumps({"images": [entry]}))
    return tmp_path


def test_a_folder_is_looked_at(tmp_path: Path) -> None:
    square = {"class": "square", "centre_px": [89.5, 89.5], "bbox_px": [60, 60, 60, 60], "hole": False}
    pictures = list(evaluate_images(folder_with(tmp_path, [square]), load_recipe("precise")))
    figures = summary(tmp_path, "precise", pictures)
    assert (figures["right"], figures["false"]) == (1, 0)
    # The square is drawn on whole pixels without noise: its outline is good to a tenth.
    assert figures["center_error_px"]["max"] < 0.1
    text = page(figures, pictures)
    assert text.count("data:image/jpeg") == 1
    assert "http" not in text


def test_the_worst_come_first() -> None:
    good = compare("good", IMAGE, [marked((0, 0, 20, 20))], (found((0, 0, 20, 20)),))
    off = compare("off", IMAGE, [marked((0, 0, 20, 20))], (found((4, 0, 20, 20)),))
    bad = compare("bad", IMAGE, [marked((0, 0, 20, 20))], ())
    assert [picture.name for picture in worst([good, off, bad])] == ["bad", "off", "good"]


@pytest.mark.parametrize("objects", [[{"class": "blob", "centre_px": [1, 2], "bbox_px": [0, 0, 1, 1]}], [{}], 3])
def test_annotations_of_another_kind_are_refused_by_name(tmp_path: Path, objects: object) -> None:
    with pytest.raises(InputError, match=r"annotations\.json"):
        list(annotated_pictures(folder_with(tmp_path, objects)))


def test_a_folder_without_annotations_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no annotations"):
        list(annotated_pictures(tmp_path))
