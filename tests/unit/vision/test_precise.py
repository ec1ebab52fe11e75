"""The recipe `precise` on pictures with exact truth."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from controller.domain import Detection, Shape
from controller.geometry import CameraModel, PlaneMap, angle_difference, pose, pose_from_rvec
from controller.vision.detect import detect
from controller.vision.noise import least_step
from controller.vision.rays import RAYS, find_edges
from controller.vision.recipe import load_recipe
from tests.unit.vision.pictures import at, corners, frame, paint

RECIPE = load_recipe("precise")
DARK = (70.0, 75.0, 65.0)
KNOWN = [Shape.SQUARE, Shape.RECTANGLE, Shape.CIRCLE, Shape.HEXAGON, Shape.TRIANGLE]
FAINT_ROW = [(Shape.CIRCLE, 120.0), (Shape.SQUARE, 320.0), (Shape.HEXAGON, 520.0)]


def found(image: NDArray[np.uint8]) -> tuple[Detection, ...]:
    return detect(frame(image), RECIPE).detections


def only(image: NDArray[np.uint8]) -> Detection:
    detections = found(image)
    assert len(detections) == 1, [(d.shape, d.center_px, d.size_px) for d in detections]
    return detections[0]


@pytest.mark.parametrize("shape", KNOWN)
@pytest.mark.parametrize("colour", [DARK, (250.0, 250.0, 250.0), (90.0, 90.0, 240.0)])
def test_known_shapes_are_named_and_measured(shape: Shape, colour: tuple[float, float, float]) -> None:
    turn = math.radians(17.0)
    outline = corners(shape, 60.0, turn)
    item = only(paint([(at(outline, 150.3, 118.6), colour)], table=(200.0, 205.0, 195.0)))
    assert item.shape is shape
    # Contrast 50..130 levels at noise 2: the Cramer-Rao bound is below 0.01 px.
    assert item.center_px == pytest.approx(np.add(outline.mean(axis=0), (150.3, 118.6)), abs=0.05)
    covered = abs(cv2.contourArea(outline.astype(np.float32)))
    assert item.area_px == pytest.approx(covered, rel=0.01)
    if shape.period is None:
        assert item.angle is None
    else:
        assert item.angle is not None
        # A side lies along `turn`; a triangle's is walked against it or along, by the corner order.
        along = turn + (math.pi if shape is Shape.TRIANGLE else 0.0)
        apart = min(abs(angle_difference(item.angle, a, shape.period)) for a in (turn, along))
        assert apart < math.radians(0.3)
    assert item.score > 0.8
    assert item.flags == frozenset()


@settings(max_examples=12, deadline=None)
@given(
    shape=st.sampled_from(KNOWN), turn=st.floats(0.0, 2.0 * math.pi), size=st.floats(16.0, 120.0),
    x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5),
)  # fmt: skip
def test_turn_place_and_size_do_not_matter(shape: Shape, turn: float, size: float, x: float, y: float) -> None:
    outline = at(corners(shape, size, turn), 160.0 + x, 120.0 + y)
    item = only(paint([(outline, DARK)]))
    assert item.shape is shape
    assert item.center_px == pytest.approx(outline.mean(axis=0), abs=0.15)


def test_a_dozen_pixels_tell_a_shape_in_large_frames() -> None:
    # More than half a million pixels are searched at half the size, where these are five pixels wide.
    shapes = [(Shape.SQUARE, Shape.CIRCLE, Shape.HEXAGON)[k % 3] for k in range(24)]
    patches = []
    for k, shape in enumerate(shapes):
        outline = at(corners(shape, 12.0, 0.31 * k), 25.0 + 0.17 * k, 25.0 + 0.23 * k)
        patches.append(paint([(outline, DARK)], size=(50, 50), noise=3.0))
    image = np.full((500, 1200, 3), 200, np.uint8) + np.random.default_rng(2).integers(-4, 5, (500, 1200, 3))
    image[100:150] = np.concatenate(patches, axis=1)
    seen = sorted(found(np.asarray(image, np.uint8)), key=lambda d: d.center_px[0])
    assert [d.shape for d in seen] == shapes


def test_an_empty_table_gives_nothing() -> None:
    light = np.linspace(0.6, 1.0, 320)[None, :, None]
    table = paint([], noise=4.0).astype(float) * light
    assert found(np.asarray(table, np.uint8)) == ()


def test_a_frame_full_of_specks_is_looked_at_whole() -> None:
    # More regions than OpenCV interpolates rows for at once (32767, 64 rays each).
    image = np.full((72, 640, 3), 200, np.uint8)
    image[4::9, 4::9] = image[5::9, 4::9] = image[4::9, 5::9] = image[5::9, 5::9] = 90
    centers = np.stack(np.meshgrid(np.arange(4.5, 640.0, 9.0), np.arange(4.5, 72.0, 9.0)), axis=-1).reshape(-1, 2)
    edges, weight = find_edges(
        image.astype(np.float32), np.broadcast_to(np.eye(3), (len(centers), 3, 3)), centers,
        np.full((len(centers), RAYS), 2.0), np.full(len(centers), 3.0),
    )
    assert edges.shape[0] == weight.shape[0] == len(centers) > 511
    # A speck of 2 x 2 px between two pixels: the first and the last are the same, seen on the same rays.
    assert np.median(np.abs(edges[-1] - centers[-1] - (edges[0] - centers[0]))) < 0.2


def test_a_small_part_that_touches_a_large_one_within_its_box_is_found() -> None:
    large, small = at(corners(Shape.CIRCLE, 64.0), 140, 110), at(corners(Shape.HEXAGON, 30.0, 0.2), 140 + 33, 110 + 33)
    items = found(paint([(large, DARK), (small, DARK)]))
    assert sorted(d.shape for d in items) == [Shape.CIRCLE, Shape.HEXAGON]


def test_compression_is_no_part() -> None:
    things = [(at(corners(Shape.SQUARE, 40.0, 0.3), 80, 120), DARK), (at(corners(Shape.CIRCLE, 40.0), 240, 120), DARK)]
    _, data = cv2.imencode(".jpg", paint(things, noise=3.0), [cv2.IMWRITE_JPEG_QUALITY, 50])
    picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    assert sorted(d.shape for d in found(picture)) == [Shape.CIRCLE, Shape.SQUARE]


@pytest.mark.parametrize("seed", [5, 7])
def test_colours_blocks_in_noise_are_no_parts(seed: int) -> None:
    # Compression takes the noise out of the colours and leaves blocks of a few levels beside strong edges.
    named = {
        Shape.RECTANGLE: (80, 70, (110.0, 95.0, 90.0)), Shape.HEXAGON: (200, 80, (60.0, 60.0, 75.0)),
        Shape.SQUARE: (90, 170, (60.0, 75.0, 85.0)), Shape.CIRCLE: (230, 170, (85.0, 75.0, 65.0)),
    }  # fmt: skip
    things = [(at(corners(shape, 50.0), x, y), colour) for shape, (x, y, colour) in named.items()]
    chance = np.random.default_rng(seed)
    clean = paint(things) + 55.0
    own, common = chance.standard_normal(clean.shape), chance.standard_normal((*clean.shape[:2], 1))
    noisy = np.clip(clean + 8.0 * own + 6.0 * common, 0, 255).astype(np.uint8)
    assert least_step(noisy) == 0.0
    _, data = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 50])
    picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    assert least_step(picture) > 6.0
    assert sorted(d.shape for d in found(picture)) == sorted(named)


def test_touching_parts_are_two() -> None:
    left = at(corners(Shape.SQUARE, 50.0), 110.0, 120.0)
    right = at(corners(Shape.CIRCLE, 44.0), 110.0 + 25.0 + 22.0, 120.0)
    items = found(paint([(left, DARK), (right, (90.0, 70.0, 60.0))]))
    assert sorted(d.shape for d in items) == [Shape.CIRCLE, Shape.SQUARE]


def test_a_shadow_is_not_part_of_the_outline() -> None:
    outline = at(corners(Shape.HEXAGON, 70.0, 0.3), 150.0, 110.0)
    shade: NDArray[np.float64] = np.zeros((240, 320))
    cv2.fillPoly(shade, [np.rint(at(outline, 8, 9)).astype(np.int32)], (1.0,))
    light = 1.0 - 0.35 * cv2.GaussianBlur(shade, (0, 0), 4.0)
    table = paint([]).astype(float) * light[:, :, None]
    covered = paint([(outline, (0.0, 0.0, 0.0))], table=(255.0, 255.0, 255.0), noise=0.0)[:, :, :1] / 255.0
    item = only(np.asarray(np.clip(table * covered + 60.0 * (1.0 - covered), 0, 255), np.uint8))
    assert item.shape is Shape.HEXAGON
    assert item.center_px == pytest.approx((150.0, 110.0), abs=0.3)


def test_isoluminant_colour_is_found() -> None:
    # Same luminance as the table: 0.114 B + 0.587 G + 0.299 R = 150.
    colour = (255.0, 82.0, 243.0)
    assert abs(0.114 * colour[0] + 0.587 * colour[1] + 0.299 * colour[2] - 150.0) < 1.0
    item = only(paint([(at(corners(Shape.CIRCLE, 50.0), 160, 120), colour)], table=(150.0, 150.0, 150.0)))
    assert item.shape is Shape.CIRCLE


def test_a_ring_is_a_circle_with_a_hole() -> None:
    ring = at(corners(Shape.CIRCLE, 70.0), 160, 120)
    hole = at(corners(Shape.CIRCLE, 36.0), 160, 120)
    item = only(paint([(ring, DARK), (hole, (200.0, 200.0, 200.0))]))
    assert item.shape is Shape.CIRCLE
    assert item.flags == {"hole"}
    assert item.area_px == pytest.approx(math.pi * 35.0**2, rel=0.01)


def test_an_object_cut_by_the_border_is_flagged() -> None:
    items = found(paint([(at(corners(Shape.SQUARE, 60.0), 5.0, 120.0), DARK)]))
    assert items
    assert all("cut_by_border" in item.flags for item in items)


def test_an_l_is_neither_a_rectangle_nor_two() -> None:
    outline = at(np.array([[0, 0], [25, 0], [25, 60], [80, 60], [80, 85], [0, 85]], float), 110, 70)
    item = only(paint([(outline, DARK)]))
    assert item.shape is Shape.OTHER
    assert item.center_px == pytest.approx((138.5, 123.3), abs=4.0)


def camera(tilt: float) -> PlaneMap:
    """A wide lens 600 mm over the table, leaning by `tilt`."""
    matrix = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    lens = CameraModel(matrix, np.array([-0.25, 0.06, 0.0, 0.0, 0.0]), (640, 480))
    down = pose(0.0, 0.0, 0.0) @ pose_from_rvec([math.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    lean = pose_from_rvec([tilt, 0.0, 0.0], [0.0, 0.0, 0.0])
    T = down @ lean
    T[:3, 3] = -T[:3, :3] @ np.array([0.0, 0.0, 600.0])
    return PlaneMap(lens, T, 0.0)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0, 35.0])
@pytest.mark.parametrize("shape", [Shape.SQUARE, Shape.CIRCLE, Shape.HEXAGON])
def test_shape_is_decided_in_the_plane(shape: Shape, tilt_deg: float) -> None:
    plane = camera(math.radians(tilt_deg))
    center = np.array([90.0, 60.0])
    # Many points a side, so that the drawn sides bend as the lens bends them.
    ring = corners(shape, 80.0, 0.4)
    pairs = zip(ring, np.roll(ring, -1, axis=0), strict=True)
    fine = np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 20)[:, None] for a, b in pairs])
    image = paint([(plane.to_pixels(center + fine), DARK)], size=(640, 480))
    items = detect(frame(image), RECIPE, plane=plane).detections
    assert [item.shape for item in items] == [shape]
    # 0.1 px of about 1.3 mm.
    assert plane.to_plane([items[0].center_px])[0] == pytest.approx(center + ring.mean(axis=0), abs=0.15)


def test_only_the_region_counts() -> None:
    image = paint([(at(corners(Shape.SQUARE, 40.0), 80, 120), DARK), (at(corners(Shape.CIRCLE, 40.0), 240, 120), DARK)])
    region = np.zeros(image.shape[:2], np.uint8)
    region[:, 160:] = 255
    items = detect(frame(image), RECIPE, region=region).detections
    assert [item.shape for item in items] == [Shape.CIRCLE]


def test_the_trace_holds_named_pictures_and_the_timing_adds_up() -> None:
    trace: dict[str, NDArray[np.generic]] = {}
    image = paint([(at(corners(Shape.SQUARE, 40.0), 80, 120), DARK)])
    detected = detect(frame(image), RECIPE, trace=trace)
    assert {"strength", "chroma", "edges"} <= set(trace)
    stages = sum(value for name, value in detected.timing_ms.items() if name != "total")
    assert stages <= detected.timing_ms["total"] + 1e-6


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (40, 3), (9, 9), (33, 17)])
@pytest.mark.parametrize("level", [0, 255])
def test_tiny_and_flat_pictures_give_nothing(size: tuple[int, int], level: int) -> None:
    assert found(np.full((size[1], size[0], 3), level, np.uint8)) == ()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), width=st.integers(8, 90), height=st.integers(8, 90), smooth=st.floats(0.0, 6.0))
def test_no_picture_crashes_it(seed: int, width: int, height: int, smooth: float) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    if smooth > 0.3:
        soft = cv2.GaussianBlur(image.astype(np.float64), (0, 0), smooth)
        image = np.asarray(255.0 * (soft - soft.min()) / max(float(np.ptp(soft)), 1e-9), np.uint8)
    for item in found(image):
        assert np.isfinite(item.outline_px).all()
        assert 0.0 <= item.score <= 1.0
        assert item.area_px > 0.0


def test_gray_parts_that_hardly_stand_out_of_a_gray_grain_are_found() -> None:
    # The grain varies as much as the parts differ, but slowly: only as steps do they stand out.
    rng = np.random.default_rng(5)
    grain = cv2.resize(cv2.GaussianBlur(rng.standard_normal((30, 40)), (0, 0), 1.5), (640, 480))
    grain *= 3.0 / grain.std()
    things = [(at(corners(shape, 90.0, 0.3), x, 240.0), (188.0, 188.0, 188.0)) for shape, x in FAINT_ROW]
    image = paint(things, size=(640, 480), noise=0.0) + grain[:, :, None] + 3.0 * rng.standard_normal((480, 640, 3))
    seen = sorted(found(np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)), key=lambda d: d.center_px[0])
    assert [d.shape for d in seen] == [shape for shape, _ in FAINT_ROW]


@pytest.mark.parametrize("soft", [3.0, 9.0])
def test_a_shadow_that_falls_in_from_beyond_the_picture_is_no_part(soft: float) -> None:
    part = at(corners(Shape.HEXAGON, 60.0, 0.2), 60.0, 190.0)
    shade: NDArray[np.float64] = np.zeros((240, 320))
    cv2.fillPoly(shade, [np.array([[150, 90], [320, 20], [320, 90], [170, 130]], np.int32)], (1.0,))
    light = 1.0 - 0.4 * cv2.GaussianBlur(shade, (0, 0), soft)[:, :, None]
    assert found(np.asarray(paint([]) * light, np.uint8)) == ()
    assert only(np.asarray(paint([(part, DARK)]) * light, np.uint8)).shape is Shape.HEXAGON
