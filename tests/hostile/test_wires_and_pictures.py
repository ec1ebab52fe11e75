"""Bytes from servos and clients, pictures and lists of pictures: nothing is invented from them, nothing falls over."""

from __future__ import annotations

import hashlib
import json
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.errors import SorterError
from controller.insight.images_evaluation import annotated_pictures
from controller.service.requests import READING, BadRequest, Commands, parse
from controller.vision.classes.features import LENGTH
from controller.vision.classes.markings import SIDE
from controller.vision.classes.store import TaughtClass, load_classes, save_class
from controller.vision.read import read_image
from drivers.arm.protocol import Status, StatusParser, fast_blocks
from sim_backends.virtual_dynamixel.protocol import status_packet
from tests.hostile.mutations import HOSTILE, mutated, spoiled
from tests.unit.service.cell_double import PretendedCell

# --- clients ------------------------------------------------------------------------------------------------

REQUEST = {"command": "status", "id": 7, "alarm": 3}
MOVING = ("start", "resume")


@pytest.mark.safety("SR-42", "SR-43")
@HOSTILE
@given(data=st.data())
def test_a_request_with_anything_wrong_is_refused_or_does_what_it_says(data: st.DataObject) -> None:
    """Nothing but the very words `start` and `resume` ever reaches what moves."""
    line = json.dumps(data.draw(mutated(REQUEST))).encode()
    if data.draw(st.booleans()):
        line = data.draw(spoiled(line))
    cell = PretendedCell()
    commands = Commands(cell)
    try:
        request = parse(line)
        call = commands.call(request)
        if request.command in READING:
            call()
    except BadRequest as error:
        assert error.error["code"]
        return
    finally:
        assert not set(cell.told) & set(MOVING)
    assert request.command is not None


# --- servos -------------------------------------------------------------------------------------------------

_STATUS = st.builds(Status, st.integers(0, 252), st.integers(0, 255), st.binary(max_size=40))


@pytest.mark.safety("SR-32", "SR-43")
@HOSTILE
@given(statuses=st.lists(_STATUS, min_size=1, max_size=6), data=st.data())
def test_a_spoiled_stream_gives_only_packets_that_were_in_it(statuses: list[Status], data: st.DataObject) -> None:
    line = data.draw(spoiled(b"".join(status_packet(one.servo_id, one.error, one.data) for one in statuses)))
    parser = StatusParser(60)
    found = [*parser.feed(line), *parser.flush()]
    for one in found:
        assert status_packet(one.servo_id, one.error, one.data) in line
    for size in (1, 4, 12):
        for one in fast_blocks(line, size):
            assert len(one.data) == size


# --- pictures -----------------------------------------------------------------------------------------------


def _encoded(kind: str) -> bytes:
    picture = np.random.default_rng(1).integers(0, 255, (24, 32, 3), np.uint8)
    done, data = cv2.imencode(kind, picture)
    assert done
    return data.tobytes()


PICTURES = {kind: _encoded(kind) for kind in (".png", ".jpg", ".bmp", ".webp")}


@pytest.mark.safety("SR-43")
@HOSTILE
@given(data=st.data())
def test_a_spoiled_picture_is_refused_or_a_picture(data: st.DataObject, tmp_path: Path) -> None:
    kind = data.draw(st.sampled_from(sorted(PICTURES)))
    path = tmp_path / f"picture{kind}"
    path.write_bytes(data.draw(spoiled(PICTURES[kind])))
    try:
        found = read_image(path)
    except SorterError as error:
        assert str(error).isprintable()
        return
    assert found.dtype == np.dtype(np.uint8)
    assert (found.ndim, found.shape[2]) == (3, 3)


def test_a_small_file_that_claims_a_huge_picture_is_refused(tmp_path: Path) -> None:
    """The header of a PNG says 60 000 x 60 000 pixels: 10 GB that must never be asked for."""
    content = bytearray(PICTURES[".png"])
    content[16:24] = (60_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    (tmp_path / "huge.png").write_bytes(bytes(content))
    with pytest.raises(SorterError):
        read_image(tmp_path / "huge.png")


ANNOTATIONS: dict[str, Any] = {
    "images": [
        {
            "file": "a.png",
            "objects": [
                {"class": "square", "centre_px": [1.0, 2.0], "bbox_px": [0.0, 0.0, 3.0, 4.0], "cut": True, "note": "x"},
                {"class": "circle", "centre_px": [9.0, 9.0], "bbox_px": [5.0, 5.0, 8.0, 8.0]},
            ],
        }
    ]
}


@pytest.mark.safety("SR-43")
@HOSTILE
@given(data=st.data())
def test_a_list_of_pictures_with_anything_wrong_is_read_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    raw = json.dumps(data.draw(mutated(ANNOTATIONS))).encode()
    (tmp_path / "annotations.json").write_bytes(data.draw(spoiled(raw)) if data.draw(st.booleans()) else raw)
    try:
        for path, objects in annotated_pictures(tmp_path):
            assert isinstance(path, Path)
            assert all(np.isfinite(thing.box).all() for thing in objects)
    except SorterError as error:
        assert str(error).isprintable()


@pytest.mark.safety("SR-43")
@HOSTILE
@given(data=st.data())
def test_a_taught_class_with_anything_wrong_is_refused_or_a_class(
    data: st.DataObject, taught: tuple[dict[str, Any], bytes], tmp_path: Path
) -> None:
    """With the right checksum too: the figures themselves are judged."""
    record, views = taught
    changed = data.draw(mutated(record))
    spoilt = data.draw(spoiled(views)) if data.draw(st.booleans()) else views
    if isinstance(changed, dict) and data.draw(st.booleans()):
        changed["sha256"] = hashlib.sha256(spoilt).hexdigest()
    (tmp_path / "star.json").write_text(json.dumps(changed), encoding="utf-8")
    (tmp_path / record["data"]).write_bytes(spoilt)
    try:
        for one in load_classes(tmp_path):
            assert np.isfinite(one.views).all()
    except SorterError as error:
        assert str(error).isprintable()


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], bytes]:
    """The two files of a class, as teaching writes them."""
    folder = tmp_path_factory.mktemp("classes")
    views = np.random.default_rng(1).normal(size=(6, LENGTH)).astype(np.float32)
    prints = np.zeros((6, SIDE, SIDE), np.uint8)
    path = save_class(folder, TaughtClass("star", "px", views, ("a.png",) * 6, prints))
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record, (folder / record["data"]).read_bytes()
