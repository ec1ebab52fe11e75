"""The painter: edges where they are, the right thing in front, prints and markers in their exact place."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_backends.cell import SimulatedCell
from sim_backends.cell_spec import CellSpec
from sim_backends.painter_raster import clean, coverage, offset
from sim_backends.solids import Array, regular
from tests.unit.sim_backends.rig import ARM, BINS, down

Image = NDArray[np.uint8]


def turned(ring: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(ring @ np.array([[c, s], [-s, c]]))


# --- masks -------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 72), st.floats(0.0, 3.2), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(20.0, 45.0))
def test_masks_are_neither_grown_nor_moved(corners: int, angle: float, dx: float, dy: float, radius: float) -> None:
    ring = turned(regular(corners, radius), angle) + np.array([60.0 + dx, 60.0 + dy])
    mask = coverage(ring, (0, 0, 120, 120), 4).astype(np.float64) / 255.0
    x, y = ring.T
    cross = x * np.roll(y, -1) - y * np.roll(x, -1)
    area, rim = cross.sum() / 2.0, np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1).sum()
    # OpenCV's own fill stands 0.66 px over on every side; the edges may be off by 0.03 px.
    assert abs(mask.sum() - area) / rim < 0.03
    rows, columns = np.mgrid[:120, :120]
    centre = ((mask * columns).sum() / mask.sum(), (mask * rows).sum() / mask.sum())
    assert centre == pytest.approx((60.0 + dx, 60.0 + dy), abs=0.03)


@given(st.integers(3, 90), st.floats(0.0, 6.0), st.floats(-2.0, 3.0), st.booleans())
def test_offset_moves_every_side_by_as_much(corners: int, angle: float, by: float, backwards: bool) -> None:
    ring = turned(regular(corners, 30.0), angle)
    moved = offset(ring[::-1] if backwards else ring, by)
    apothem = 30.0 * math.cos(math.pi / corners)
    middles = (moved + np.roll(moved, -1, axis=0)) / 2.0
    assert np.linalg.norm(middles, axis=1) == pytest.approx(apothem + by)


def test_repeated_corners_are_dropped() -> None:
    ring = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 0.001], [5.0, 5.0], [0.001, 0.0]])
    assert len(clean(ring)) == 3


# --- pictures ------------------------------------------------------------------------------------------------

PLAIN = {"shadow_depth": 0.0, "blur": 0.0}


def cell(**changes: object) -> SimulatedCell:
    options: dict[str, object] = {"parts": 5, "level": "ideal", "overrides": PLAIN, "seed": 2}
    spec = CellSpec(ARM, BINS, **{**options, **changes})  # type: ignore[arg-type]  # a table of options
    return SimulatedCell(spec)


def away(cell_: SimulatedCell) -> None:
    """Fold the arm up, out of the picture."""
    stand(cell_, np.array([0.0, -1.05, 1.4, -1.66, 0.0]))


def stand(cell_: SimulatedCell, angles: Array) -> None:
    world = cell_.world
    for joint, angle in zip(ARM.joints, angles, strict=True):
        world._data.qpos[world._model.joint(joint.name).qposadr[0]] = angle


@pytest.fixture(scope="module")
def plain() -> SimulatedCell:
    """A cell in plain light, its arm out of the picture."""
    made = cell()
    away(made)
    made.camera.open()
    return made


def difference(cell_: SimulatedCell) -> tuple[Image, Image]:
    """The picture with parts, and without."""
    snapshot = cell_.world.snapshot()
    with_parts = cell_._painter.paint(snapshot)
    cell_.set_aside()
    without = cell_._painter.paint(cell_.world.snapshot())
    cell_.scatter()
    return with_parts, without


def test_outlines_of_parts_are_where_the_lens_puts_them(plain: SimulatedCell) -> None:
    """Along every straight part of every outline the half-way level lies on the true edge, to 0.03 px."""
    painted, bare = difference(plain)
    contrast = np.abs(painted.astype(np.float32) - bare).sum(axis=2)
    errors = []
    for index in range(len(plain.world.parts)):
        for middle, normal in true_edges(plain, index):
            at = middle + np.arange(-3.0, 3.01, 0.05)[:, None] * normal
            profile = cv2.remap(
                contrast,
                at[:, 0].astype(np.float32).reshape(-1, 1),
                at[:, 1].astype(np.float32).reshape(-1, 1),
                cv2.INTER_LINEAR,
            ).ravel()
            inside = profile[:40].mean()
            if np.ptp(profile[:40]) > 0.1 * inside:
                continue  # a narrow side face: the level changes again right inside the edge
            # The area under an edge's profile tells where it is without a threshold.
            errors.append((profile.sum() - profile[0] / 2.0) / inside * 0.05 - 3.0)
    assert len(errors) > 100
    assert abs(float(np.mean(errors))) < 0.03
    # A single sample also carries the table's grain and the rounding of levels.
    assert float(np.std(errors)) < 0.1


def test_tops_are_of_one_tone_up_to_their_rims() -> None:
    """No side face shows through the top, however the rims of both run into each other."""
    table = cell(parts=8, seed=3)
    away(table)
    painted = table._painter.paint(table.world.snapshot())
    for part, pose in zip(table.world.parts, table.world.loose.poses(), strict=True):
        flat = turned(part.outline, 2.0 * math.atan2(pose[6], pose[3])) + pose[:2]
        pixels, _ = table.lens.project(np.column_stack([flat, np.full(len(flat), part.height)]))
        inner = np.zeros(painted.shape[:2], np.uint8)
        cv2.fillPoly(inner, [np.rint(pixels).astype(np.int32)], 1)
        inside = painted[cv2.erode(inner, np.ones((5, 5), np.uint8)) > 0]
        assert np.ptp(inside.astype(int), axis=0).max() <= 2, part.shape  # rounding only


def true_edges(cell_: SimulatedCell, index: int) -> list[tuple[Array, Array]]:
    """Points on the true outline in the picture, with the normals that point out of it."""
    part = cell_.world.parts[index]
    pose = cell_.world.loose.poses()[index]
    yaw = 2.0 * math.atan2(pose[6], pose[3])
    ring = part.outline
    share = np.arange(0, 1, 1 / 8 if len(ring) < 12 else 1.0)[:, None]
    dense = np.vstack([a + (b - a) * share for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True)])
    flat = turned(dense, yaw) + pose[:2]
    lens = cell_.lens
    pixels = []
    for z in (0.0, part.height):
        points = np.column_stack([flat, np.full(len(flat), z)])
        local = (points - lens.T_base_camera[:3, 3]) @ lens.T_base_camera[:3, :3]
        projected, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
        pixels.append(projected.reshape(-1, 2))
    hull = cv2.convexHull(np.vstack(pixels).astype(np.float32)).reshape(-1, 2).astype(np.float64)
    out = []
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        along = b - a
        if np.linalg.norm(along) > 1.5:
            normal = np.array([along[1], -along[0]]) / np.linalg.norm(along)
            middle = (a + b) / 2.0
            out.append((middle, normal if normal @ (middle - hull.mean(axis=0)) > 0.0 else -normal))
    return out


def test_a_print_on_the_table_is_where_the_lens_puts_it(plain: SimulatedCell) -> None:
    squares = np.kron((np.indices((6, 8)).sum(axis=0) % 2).astype(np.uint8), np.ones((100, 100), np.uint8)) * 255
    plain.set_aside()
    plain.presenter.lay(squares, 0.25)
    picture = plain._painter.paint(plain.world.snapshot(), plain.presenter.sheet)
    plain.presenter.remove()
    plain.scatter()
    corners = np.array([[x, y] for y in range(1, 6) for x in range(1, 8)], np.float64) * 25.0
    flat = np.zeros(len(corners))
    local = np.column_stack([corners[:, 0] - 100.0, 75.0 - corners[:, 1], flat, flat + 1.0])
    true, _ = plain.lens.project((local @ plain.T_base_table.T)[:, :3])
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    found = cv2.cornerSubPix(gray, true.astype(np.float32).reshape(-1, 1, 2), (6, 6), (-1, -1), criteria)
    error = found.reshape(-1, 2) - true
    # The detector itself scatters by some hundredths; a bias would be the painter's.
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.sqrt((error**2).mean()) < 0.08


def test_the_marker_on_the_gripper_is_seen_in_its_place(plain: SimulatedCell) -> None:
    plain.set_aside()
    stand(plain, down(210.0, 40.0, 60.0, 0.4))
    picture = plain._painter.paint(plain.world.snapshot())
    pose = plain.world.tool_pose() @ plain.T_tool_marker
    away(plain)
    plain.scatter()
    half = plain.spec.marker.size / 2.0
    local = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    true, _ = plain.lens.project(local @ pose[:3, :3].T + pose[:3, 3])
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(picture)
    assert ids.ravel().tolist() == [plain.spec.marker.marker_id]
    assert np.abs(found[0].reshape(-1, 2) - true).max() < 0.4


def test_the_arm_covers_what_lies_beneath_it(plain: SimulatedCell) -> None:
    part = max(plain.world.parts, key=lambda part: part.x)
    stand(plain, down(part.x, part.y, 60.0, part.yaw))
    covered = plain._painter.paint(plain.world.snapshot())
    away(plain)
    bare = plain._painter.paint(plain.world.snapshot())
    top = np.array([[part.x - 12.0, part.y, part.height]])
    (u, v), = plain.lens.project(top)[0]
    assert int(bare[round(v), round(u)].max()) > 100  # the part's bright colour
    assert int(covered[round(v), round(u)].max()) < 100  # the dark arm


def test_what_never_moves_is_painted_the_same_when_it_is_painted_anew(plain: SimulatedCell) -> None:
    painter = plain._painter
    bare = painter._stage.copy()
    groups = np.flatnonzero(np.isfinite(painter._group_boxes[:, 0])).tolist()
    painter._uncover(bare, groups)
    assert (bare != painter._stage).any()
    snapshot = plain.world.snapshot()
    view = painter._scene.view(painter._scene.move(snapshot.positions, snapshot.rotations), plain.lens)
    tones = painter._tones(view.normals)
    for index in painter._scene.order(view, np.isin(painter._group, groups)):
        painter._solid(bare, view, index, tones, snapshot)
    assert np.array_equal(bare, painter._stage)


def test_parts_taken_aside_leave_a_bare_table(plain: SimulatedCell) -> None:
    plain.set_aside()
    assert np.array_equal(plain._painter.paint(plain.world.snapshot()), plain._painter._stage)
    plain.scatter()


def test_shadows_fall_away_from_the_lamp_and_are_as_deep_as_asked() -> None:
    lit = cell(parts=1, overrides={"shadow_depth": 0.3, "blur": 0.0, "lamp_azimuth": 0.0}, image_size=(640, 360))
    away(lit)
    painted, bare = difference(lit)
    part = lit.world.parts[0]
    # The lamp stands ahead of the arm: shadows fall towards the base.
    reach = max(abs(part.outline[:, 0]).max(), abs(part.outline[:, 1]).max())
    edge = part.x - reach * 1.45 - 2.0
    (u, v), (a, b) = lit.lens.project(np.array([[edge, part.y, 0.0], [part.x + reach * 1.45 + 2.0, part.y, 0.0]]))[0]
    shaded = painted[round(v), round(u)].astype(float) / bare[round(v), round(u)]
    assert 0.68 < shaded.mean() < 1.0
    assert np.array_equal(painted[round(b), round(a)], bare[round(b), round(a)])
    darkest = (painted.astype(float).min(axis=2) + 1.0) / (bare.astype(float).min(axis=2) + 1.0)
    assert darkest.min() > 0.0


def test_noise_is_as_strong_as_asked_and_never_the_same_twice() -> None:
    noisy = cell(parts=1, overrides={**PLAIN, "noise": 4.0}, image_size=(640, 360))
    still = cell(parts=1, image_size=(640, 360))
    first, second = (noisy._painter.paint(noisy.world.snapshot()) for _ in range(2))
    assert (first != second).any()
    clean_ = still._painter.paint(still.world.snapshot()).astype(float)
    # Rounding to whole levels adds a twelfth of a level squared.
    assert (first - clean_)[:100].std() == pytest.approx(4.0, abs=0.2)
