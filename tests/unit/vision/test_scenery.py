from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.vision.scenery import Change, Scenery, trouble

Image = NDArray[np.uint8]
SIZE = (640, 360)


def scene(seed: int = 1, *, parts: int = 6, noise: int = 2) -> Image:
    """A grained table, two bins at its lower corners, and parts in the middle that differ from seed to seed."""
    grain = np.random.default_rng(0).normal(0.0, 40.0, (SIZE[1], SIZE[0])).astype(np.float32)
    table = 150.0 + cv2.GaussianBlur(grain, (0, 0), 5.0)
    image = np.repeat(np.clip(table, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
    for left in (40, 480):
        cv2.rectangle(image, (left, 270), (left + 110, 350), (60, 55, 50), 6)
    chance = np.random.default_rng(seed)
    for _ in range(parts):
        x, y = int(chance.integers(200, 440)), int(chance.integers(90, 240))
        cv2.circle(image, (x, y), 18, tuple(int(v) for v in chance.integers(30, 230, 3)), -1)
    return np.clip(image + chance.integers(-noise, noise + 1, image.shape), 0, 255).astype(np.uint8)


def still() -> Image:
    mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    mask[60:270, 170:470] = 0
    return mask


@pytest.fixture(scope="module")
def scenery() -> Scenery:
    return Scenery(scene(), still())


def moved(image: Image, dx: float, dy: float, turn: float = 0.0) -> Image:
    matrix = cv2.getRotationMatrix2D(((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2), math.degrees(turn), 1.0)
    matrix[0, 2] += dx
    matrix[1, 2] += dy
    return cv2.warpAffine(image, matrix, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(
        np.uint8, copy=False
    )


def test_other_parts_on_the_table_change_nothing(scenery: Scenery) -> None:
    for seed in range(2, 6):
        change = scenery.compare(scene(seed, parts=seed))
        # A tenth of a pixel of the reduced picture: what its noise allows.
        assert change.displacement < 0.4
        assert change.agreement > 0.95
        assert trouble(change) is None


def test_an_arm_over_a_table_lit_from_one_side_changes_nothing() -> None:
    light = np.linspace(0.7, 1.3, SIZE[0])[None, :, None]
    empty, armed = ((scene(seed) * light).clip(0, 255).astype(np.uint8) for seed in (1, 2))
    armed[250:330, 470:] = 20  # some of what is still
    change = Scenery(empty, still()).compare(armed)
    assert change.brightness == pytest.approx(1.0, abs=0.005)
    assert change.displacement < 0.4
    assert trouble(change) is None


@pytest.mark.parametrize("shift", [(0.5, 0.0), (2.0, -1.0), (-5.0, 4.0), (9.0, 0.0)])
def test_a_shift_of_the_camera_is_measured(scenery: Scenery, shift: tuple[float, float]) -> None:
    change = scenery.compare(moved(scene(2), *shift))
    assert change.displacement == pytest.approx(math.hypot(*shift), abs=0.4)
    assert (trouble(change) is not None) == (math.hypot(*shift) > 2.0)


def test_a_turn_of_the_camera_is_a_move(scenery: Scenery) -> None:
    change = scenery.compare(moved(scene(2), 0.0, 0.0, math.radians(1.0)))
    still_rows, still_columns = np.nonzero(still())
    radii = np.hypot(still_columns - (SIZE[0] - 1) / 2, still_rows - (SIZE[1] - 1) / 2)
    # The mask of the reduced picture loses its border, where the way is longest: a tenth less.
    assert change.displacement == pytest.approx(math.radians(1.0) * math.sqrt(np.mean(radii**2)), rel=0.1)
    found = trouble(change)
    assert found is not None
    assert "the camera was moved" in found[1]


def test_something_new_in_the_still_part_is_not_a_move(scenery: Scenery) -> None:
    picture = scene(2)
    picture[275:345, 50:140] = (20, 160, 60)  # a bin has been filled
    picture[300:, 250:390] = 35  # the arm has come to rest there
    change = scenery.compare(picture)
    assert change.displacement < 0.4
    assert trouble(change) is None


@pytest.mark.parametrize("factor", [0.5, 0.85, 1.3])
def test_brightness_is_measured_and_is_not_a_move(scenery: Scenery, factor: float) -> None:
    change = scenery.compare(cv2.convertScaleAbs(scene(2), alpha=factor).astype(np.uint8))
    assert change.brightness == pytest.approx(factor, abs=0.02)  # rounding to whole grey values, clipping
    assert change.displacement < 0.4
    assert (trouble(change) is None) == (0.7 <= factor <= 1.4)


@pytest.mark.safety("SR-31")
def test_a_soft_lens_is_told(scenery: Scenery) -> None:
    found = trouble(scenery.compare(cv2.GaussianBlur(scene(2), (0, 0), 5.0).astype(np.uint8)))
    assert found is not None
    assert "soft" in found[1]


def test_an_arm_over_the_better_part_of_the_edges_is_no_soft_lens(scenery: Scenery) -> None:
    image = scene(2)
    image[255:, 20:165] = 40  # over one bin, and over a wall of the other
    image[255:, 520:] = 40
    assert trouble(scenery.compare(image)) is None


@pytest.mark.safety("SR-31")
def test_a_covered_view_is_told(scenery: Scenery) -> None:
    picture = scene(2)
    picture[:, :450] = (90, 120, 180)
    assert trouble(scenery.compare(picture)) is not None


def test_a_checked_cloth_as_bright_as_the_table_covers_the_view(scenery: Scenery) -> None:
    picture = scene(2)
    rows, columns = np.indices((3 * SIZE[1] // 4, SIZE[0])) // 40
    picture[: 3 * SIZE[1] // 4] = np.where(((rows + columns) % 2)[..., None], 60, 160)
    found = trouble(scenery.compare(picture))
    assert found is not None
    assert found[0] == "covered"


@pytest.mark.safety("SR-31")
def test_another_view_is_told(scenery: Scenery) -> None:
    assert trouble(scenery.compare(scene(2)[::-1, ::-1].copy())) is not None
    assert trouble(scenery.compare(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))) is not None


def test_a_reference_without_scenery_is_refused() -> None:
    with pytest.raises(ValueError, match="nothing to hold on to"):
        Scenery(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8), still())
    with pytest.raises(ValueError, match="too little"):
        Scenery(scene(), np.zeros((SIZE[1], SIZE[0]), np.uint8))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (Change(0.5, 0.9, 1.0, 1.0), None),
        (Change(2.5, 0.9, 1.0, 1.0), "moved: the picture is off by 2.5 px"),
        (Change(0.5, 0.5, 1.0, 1.0), "something stands in it"),
        (Change(0.5, 0.9, 0.6, 1.0), "light is 60%"),
        (Change(0.5, 0.9, 1.0, 0.7), "soft"),
    ],
)
def test_each_trouble_has_its_words(change: Change, says: str | None) -> None:
    found = trouble(change)
    assert found is None if says is None else found is not None and says in found[1]


def grained(seed: int, table: float) -> Image:
    """A scene with the light at `table` times its strength: grain of three levels, noise of two, two bins below."""
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 40.0, SIZE[::-1]).astype(np.float32), (0, 0), 4.0)
    image = np.repeat((150.0 + grain)[:, :, None], 3, axis=2)
    for left in (40, 480):
        cv2.rectangle(image, (left, 290), (left + 110, 350), (60, 55, 50), 6)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(table * image + noise, 0, 255).astype(np.uint8)


def test_a_sheet_as_bright_as_the_table_is_no_change_of_light() -> None:
    scenery = Scenery(grained(1, 1.0), still())
    for seed in range(2, 8):
        assert trouble(scenery.compare(grained(seed, 1.0))) is None
    for seed, light in ((8, 1.0), (9, 0.8), (10, 1.2)):
        change = scenery.compare(grained(seed, light))
        assert change.grain > 0.9
        assert trouble(change) is None
    bumped = scenery.compare(moved(grained(12, 1.0), -6.0, 4.0, math.radians(0.5)))
    assert bumped.grain > 0.9  # the move undone
    covered = grained(11, 0.8)
    # The bins' edges, by which sharpness is judged, stay in view.
    covered[:280] = np.clip(120.0 + np.random.default_rng(12).normal(0.0, 2.0, (280, SIZE[0], 3)), 0, 255)
    change = scenery.compare(covered)
    assert change.agreement > 0.9  # by brightness alone nothing has changed but the light
    found = trouble(change)
    assert found is not None
    assert found[0] == "covered"


def test_noise_is_no_grain() -> None:
    def plain(seed: int) -> Image:
        image = np.full((*SIZE[::-1], 3), 150.0)
        for left in (40, 480):
            cv2.rectangle(image, (left, 270), (left + 110, 350), (60, 55, 50), 6)
        return np.clip(image + np.random.default_rng(seed).normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)

    scenery = Scenery(plain(1), still())
    for seed in range(2, 22):
        assert trouble(scenery.compare(plain(seed))) is None
