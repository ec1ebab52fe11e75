"""The paper's building blocks against values of GNU Octave's image package (../shared/golden)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.vision import morphology, operators

Image = NDArray[np.uint8]


@pytest.fixture
def golden(shared: Path) -> Path:
    return shared / "golden"


def values(golden: Path) -> dict[str, Any]:
    return dict(json.loads((golden / "golden.json").read_text()))


def picture(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return np.asarray(image, np.uint8)


def mask(path: Path) -> Image:
    return (picture(path) > 0).astype(np.uint8)


def listed(item: Any) -> list[Any]:
    return item if isinstance(item, list) else [item]


def test_masks_are_filled_and_opened_exactly(golden: Path) -> None:
    operations: dict[str, Callable[[Image], Image]] = {
        "fill": morphology.fill_holes,
        "fill8": lambda m: morphology.fill_holes(m, 8),
        "areaopen5": lambda m: morphology.area_open(m, 5),
        "areaopen20": lambda m: morphology.area_open(m, 20),
        "areaopen20c4": lambda m: morphology.area_open(m, 20, 4),
        "open_disk1": lambda m: morphology.open_disk(m, 1),
        "open_disk2": lambda m: morphology.open_disk(m, 2),
        "open_disk3": lambda m: morphology.open_disk(m, 3),
    }
    for entry in values(golden)["masks"]:
        given = mask(golden / "in" / f"{entry['name']}.png")
        for name, operation in operations.items():
            wanted = mask(golden / "out" / f"{entry['name']}__{name}.png")
            assert np.array_equal(operation(given), wanted), (entry["name"], name)


def test_disks_have_the_toolboxs_pixels(golden: Path) -> None:
    counts = values(golden)["strel_disk_r0_count"]
    assert [int(morphology.disk(r).sum()) for r in range(1, 1 + len(counts))] == counts


def test_components_are_measured_exactly(golden: Path) -> None:
    for entry in values(golden)["masks"]:
        given = mask(golden / "in" / f"{entry['name']}.png")
        found = morphology.components(given)
        wanted = listed(entry["regionprops"])
        assert len(found) == len(wanted) == entry["n8"]
        assert morphology.bwarea(given) == pytest.approx(entry["bwarea"], abs=1e-9)
        for item, props in zip(found, wanted, strict=True):
            assert item.area == props["Area"]
            # 1-based there, 0-based here; the box starts at the pixel's edge in both.
            assert np.add(item.centroid, 1.0) == pytest.approx(props["Centroid"], abs=1e-9)
            assert [item.bbox[0] + 1, item.bbox[1] + 1, *item.bbox[2:]] == pytest.approx(props["BoundingBox"])
            assert item.major == pytest.approx(props["MajorAxisLength"], abs=1e-9)
            assert item.minor == pytest.approx(props["MinorAxisLength"], abs=1e-9)
            if props["MajorAxisLength"] > props["MinorAxisLength"] * (1.0 + 1e-6):
                # Isotropic components have no direction; +-90 is the same axis.
                apart = (item.orientation - props["Orientation"] + 90.0) % 180.0 - 90.0
                assert apart == pytest.approx(0.0, abs=1e-9), entry["name"]
            assert -90.0 < item.orientation <= 90.0


def test_boundaries_are_walked_exactly(golden: Path) -> None:
    for entry in values(golden)["masks"]:
        given = mask(golden / "in" / f"{entry['name']}.png")
        bounds = entry["bwboundaries8"]
        lengths, counts = np.atleast_1d(bounds["length"]), np.atleast_1d(bounds["npoints_closed"])
        wanted = sorted((int(n), round(float(length), 6)) for n, length in zip(counts, lengths, strict=True))
        chains = [morphology.boundary(item.mask) for item in morphology.components(given)]
        # The toolbox repeats the first point at the end.
        found = sorted((len(chain) + 1, round(morphology.chain_length(chain), 6)) for chain in chains)
        assert found == wanted, entry["name"]


def test_gray_chain_is_exact(golden: Path) -> None:
    for entry in values(golden)["images"]:
        name = entry["name"]
        given = picture(golden / "in" / f"{name}.png")
        gray = operators.gray(given)
        if given.ndim == 3:
            assert np.array_equal(gray, picture(golden / "out" / f"{name}__rgb2gray.png"))
            # Through CIE Lab and back: one level of rounding.
            sharp = operators.unsharp_mask(given).astype(int)
            assert np.abs(sharp - picture(golden / "out" / f"{name}__imsharpen.png")).max() <= 1
        else:
            assert np.array_equal(operators.unsharp_mask(given), picture(golden / "out" / f"{name}__imsharpen.png"))
        assert np.array_equal(operators.median(gray, 3, True), picture(golden / "out" / f"{name}__medfilt2.png"))
        assert np.array_equal(operators.median(gray), picture(golden / "out" / f"{name}__medfilt2_sym.png"))
        assert list(operators.stretch_limits(gray)) == entry["stretchlim_x255"]
        assert np.array_equal(operators.stretch(gray), picture(golden / "out" / f"{name}__imadjust.png"))
        # Rounded down where two levels are equally good.
        assert operators.otsu_threshold(gray) == int(entry["graythresh"] * 255 + 1e-6)
