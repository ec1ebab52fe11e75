"""Pictures of the cell with OpenCV alone: what the simulated camera sees, and portraits for people.

Order of painting: room, table, prints on it, soft shadows, then all solids far to near, hands' boards, and
last what lens and sensor add. Edges are unbiased (see `painter_raster`); distortion and perspective are exact.

Known limits: shadows fall on the table only; solids are convex.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_backends.imperfections import Imperfections
from sim_backends.lens import Lens
from sim_backends.painter_raster import GROWTH, blend, clean, coverage, distinct, fill, offset, region_of
from sim_backends.painter_scene import Scene, View, meet
from sim_backends.painter_shadow import Shadows
from sim_backends.painter_surface import NO_MAP, Print, Projector, table_texture
from sim_backends.sketch import Sketcher
from sim_backends.solids import Array, Solid, box
from sim_backends.world import Snapshot
from sim_backends.world_model import TABLE_HIGH, TABLE_LOW, TABLE_THICKNESS

Image = NDArray[np.uint8]

_AMBIENT = 0.55
_ROOM = (62.0, 58.0, 56.0)
_TABLE_EDGE = (118.0, 132.0, 142.0)
_TEXTURE_PER_MM = 2.0
# Solids up to this size in the picture are drawn four times as fine, larger ones twice: nobody measures those, px.
_SMALL = 160
_BLEED = 3.0  # how far inner faces are drawn beyond the outline that will cut them off, px


class Painter:
    """Paints one world for one camera.

    Args:
        solids: Everything convex in the world.
        bodies: Index of the body that carries each, as in a snapshot.
        parts: Which of the solids are parts (not painted while they are set aside).
        groups: For solids that never move the name of what they are part of, e.g. a bin; "" for the others.
        lens: The camera.
        look: Light, defocus and sensor.
        seed: Of the table's grain and the noise.
        decals: Pictures shown on solids that name them: the print in the coordinates of the solid's body.
        prints: Prints that lie on the table for good.
    """

    def __init__(
        self,
        solids: Sequence[Solid],
        bodies: Sequence[int],
        parts: Sequence[bool],
        groups: Sequence[str],
        lens: Lens,
        look: Imperfections,
        seed: int,
        decals: Mapping[str, Print],
        prints: Sequence[Print] = (),
    ) -> None:
        self.lens = lens
        self._look = look
        self._seed = seed
        self._scene = Scene(solids, bodies)
        self._bodies = tuple(bodies)
        self._parts = np.asarray(parts, bool)
        self._decals = {i: decals[s.decal] for i, s in enumerate(solids) if s.decal}
        self._projector = Projector(lens)
        self._lamp = _direction(look.lamp_azimuth, look.lamp_elevation)
        self._shadows = Shadows(self._scene, lens, self._lamp, look.shadow_depth)
        self._colours = np.array([s.colour for s in solids for _ in s.faces])
        self._light = self._light_field()
        self._noise = self._noise_bank()
        self._noise_random = np.random.default_rng([seed, 6])
        self._fixed = np.array([bool(g) for g in groups])
        names = sorted(set(groups) - {""})
        self._group = np.array([names.index(g) if g else -1 for g in groups])
        self._prints = prints
        self._set_stage(len(names))
        self._sketcher: Sketcher | None = None

    def _set_stage(self, groups: int) -> None:
        """Paint once what never moves: the ground with its shadows, and on a copy of it the fixed solids."""
        still = Snapshot(0.0, np.zeros((1, 3)), np.eye(3)[None], False)
        vertices = np.zeros((self._scene.vertex_count, 3))
        for fixed in np.flatnonzero(self._fixed):
            rows = self._scene.vertices_of(int(fixed))
            vertices[rows] = self._scene.local[rows]
        self._ground = self._paint_ground()
        for print_ in self._prints:
            self._lay(self._ground, print_)
        self._shadows.fix(self._ground, vertices, self._fixed)
        view = self._scene.view(vertices, self.lens)
        tones = self._tones(view.normals)
        order = self._scene.order(view, self._fixed)
        self._stage = self._ground.copy()
        self._group_boxes = np.full((groups, 4), np.nan)
        for index in order:
            self._solid(self._stage, view, index, tones, still)
        for group in range(groups):
            seen = [i for i in order if self._group[i] == group]
            if seen:
                self._group_boxes[group, :2] = view.boxes[seen, :2].min(axis=0) - 2.0
                self._group_boxes[group, 2:] = view.boxes[seen, 2:].max(axis=0) + 3.0

    def paint(self, snapshot: Snapshot, sheet: Print | None = None, board: Print | None = None) -> Image:
        """The picture, (H, W, 3), dtype uint8, BGR.

        Args:
            snapshot: The moment.
            sheet: A print that lies on the table, clear of what is fixed there.
            board: A print held between everything else and the camera.
        """
        picture = self._stage.copy()
        if sheet is not None:
            self._lay(picture, sheet)
        moving = self._moving(snapshot)
        vertices = self._scene.move(snapshot.positions, snapshot.rotations)
        view = self._scene.view(vertices, self.lens)
        again = self._overlapped(view.boxes[moving & view.inside])
        if again:
            self._uncover(picture, again)
        self._shadows.darken(picture, vertices, moving)
        tones = self._tones(view.normals)
        for index in self._scene.order(view, moving | np.isin(self._group, again)):
            self._solid(picture, view, index, tones, snapshot)
        if board is not None:
            self._lay(picture, board)
        return self._expose(picture)

    def glance(self, snapshot: Snapshot) -> Image:
        """The picture of a moment without prints, an eighth as large, (H / 8, W / 8, 3), dtype uint8, BGR."""
        if self._sketcher is None:
            look, slope = self._look, self._lamp[:2] / self._lamp[2]
            self._sketcher = Sketcher(
                self._stage, self._light, self._scene, self.lens, slope, look.shadow_depth, look.noise, self._seed
            )
        vertices = self._scene.move(snapshot.positions, snapshot.rotations)
        return self._sketcher.paint(vertices, self._moving(snapshot))

    def _moving(self, snapshot: Snapshot) -> NDArray[np.bool_]:
        """Which solids are there and are not part of the stage."""
        return ~self._fixed & ~self._parts if snapshot.aside else ~self._fixed

    def _overlapped(self, boxes: Array) -> list[int]:
        """Fixed groups that something in these boxes may cover or be covered by, and those that overlap them."""
        found: list[int] = []
        while len(boxes):
            more = [int(g) for g in np.flatnonzero(meet(self._group_boxes, boxes).any(axis=1)) if g not in found]
            found += more
            boxes = self._group_boxes[more]
        return found

    def _uncover(self, picture: Image, groups: Sequence[int]) -> None:
        """Bare ground where these groups stand, to paint them anew."""
        width, height = self.lens.size
        for group in groups:
            x0, y0, x1, y1 = self._group_boxes[group]
            rows = slice(max(0, int(y0)), max(0, min(height, math.ceil(y1))))
            columns = slice(max(0, int(x0)), max(0, min(width, math.ceil(x1))))
            picture[rows, columns] = self._ground[rows, columns]

    # --- light -----------------------------------------------------------------------------------------------

    def _tones(self, normals: Array) -> Array:
        """Lambert's colour of every face; a face that looks straight up has its own colour."""
        up = _AMBIENT + (1.0 - _AMBIENT) * self._lamp[2]
        # Light from the whole sky reaches a face that looks sideways by half.
        sky = 0.5 + 0.5 * normals[:, 2]
        light = _AMBIENT * sky + (1.0 - _AMBIENT) * np.maximum(0.0, normals @ self._lamp)
        # Cameras do not store light but about its square root.
        return np.asarray(np.minimum(self._colours * np.sqrt(light / up)[:, None], 255.0))

    def _light_field(self) -> NDArray[np.float32] | None:
        """Gain of every pixel, (H, W, 3), for uneven light, vignetting and exposure."""
        look = self._look
        if look.light_gradient == 0.0 and look.vignette == 0.0 and look.exposure == 1.0:
            return None
        width, height = self.lens.size
        x = (np.arange(width, dtype=np.float32) - width / 2) / (width / 2)
        y = (np.arange(height, dtype=np.float32) - height / 2) / (width / 2)
        along = np.add.outer(math.sin(look.light_direction) * y, math.cos(look.light_direction) * x)
        span = float(along.max() - along.min())
        gain = 1.0 - look.light_gradient * (along - along.min()) / span
        radius = np.add.outer(y**2, x**2)
        gain *= (1.0 - look.vignette * radius / radius.max()) * look.exposure
        return np.asarray(cv2.merge([gain, gain, gain]), np.float32)

    # --- surfaces ----------------------------------------------------------------------------------------------

    def _paint_ground(self) -> Image:
        """Room and table, the part of every picture that never changes."""
        width, height = self.lens.size
        picture = np.empty((height, width, 3), np.uint8)
        picture[:] = np.array(_ROOM, np.uint8)
        self._paint_table_edge(picture)
        region = (0, 0, width, height)
        texture = table_texture(self._seed, TABLE_LOW, TABLE_HIGH, _TEXTURE_PER_MM)
        at = self._projector.plane(np.eye(4), region)
        low, high = np.array(TABLE_LOW, np.float32), np.array(TABLE_HIGH, np.float32)
        pixels = (at - low) * np.float32(_TEXTURE_PER_MM) - np.float32(0.5)
        top = cv2.remap(texture, pixels, NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        rim = np.concatenate([at[0], at[-1], at[:, 0], at[:, -1]])
        if ((rim > low) & (rim < high)).all() and self._projector.looks_down(region, 1).all():
            return np.asarray(top, np.uint8)
        # Where the table ends is found on a finer grid, so that its edge is smooth.
        fine = self._projector.plane(np.eye(4), region, 2)
        inside = ((fine > low) & (fine < high)).all(axis=2) & self._projector.looks_down(region, 2)
        mask = cv2.resize(inside.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_AREA)
        blend(picture, np.asarray(top, np.uint8), np.asarray(mask, np.uint8), region)
        return picture

    def _paint_table_edge(self, picture: Image) -> None:
        slab = box((*TABLE_LOW, -TABLE_THICKNESS), (*TABLE_HIGH, 0.0), body="world", colour=_TABLE_EDGE)
        scene = Scene([slab], [0])
        vertices = scene.move(np.zeros((1, 3)), np.eye(3)[None])
        view = scene.view(vertices, self.lens)
        for index in scene.order(view, np.ones(1, bool)):
            for number in range(2, 6):
                if view.visible[number]:
                    ring, _ = scene.face(view, index, number)
                    fill(picture, clean(ring), tuple(c * (0.6 + 0.08 * number) for c in _TABLE_EDGE))

    def _lay(self, picture: Image, print_: Print) -> None:
        """A print, lit as its plane is."""
        pixels, ahead = self.lens.project(_rim(print_))
        region = region_of(pixels, self.lens.size)
        if region is None or not ahead.all():
            return
        seen, mask = self._projector.warp(print_, region)
        blend(picture, seen, mask, region)

    # --- solids ------------------------------------------------------------------------------------------------

    def _solid(self, picture: Image, view: View, index: int, tones: Array, snapshot: Snapshot) -> None:
        outline = clean(self._scene.outline(view, index))
        if len(outline) < 3:
            return
        region = region_of(outline, self.lens.size)
        if region is None:
            return
        x0, y0, x1, y1 = region
        large = max(x1 - x0, y1 - y0) > _SMALL
        mask = coverage(outline, region, 2 if large else 4)
        patch = np.empty((y1 - y0, x1 - x0, 3), np.uint8)
        face0 = self._scene.face_starts[index]
        faces = np.flatnonzero(view.visible[face0 : face0 + len(self._scene.solids[index].faces)])
        origin = np.array([x0, y0], np.float64)
        patch[:] = tones[face0 + faces[-1]]
        # Face 0 last: the top's rim is the one inner edge that anybody measures.
        for number in faces[::-1]:
            self._face(patch, view, index, int(number), tones[face0 + number].tolist(), origin)
        blend(picture, patch, mask, region)
        decal = self._decals.get(index)
        if decal is not None and view.visible[face0]:
            self._lay(picture, self._carried(decal, index, snapshot))

    def _face(self, patch: Image, view: View, index: int, number: int, tone: list[float], origin: Array) -> None:
        ring, inner = self._scene.face(view, index, number)
        if number == 0:
            kept = distinct(ring)
            if kept.sum() < 3:
                return
            # Beyond the outline there is nothing to spare; towards a side face the rim lies where it is.
            ring = offset(ring[kept], np.where(inner[kept], -GROWTH, _BLEED))
        fill(patch, ring - origin, tone)

    def _carried(self, decal: Print, index: int, snapshot: Snapshot) -> Print:
        body = self._bodies[index]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = snapshot.rotations[body], snapshot.positions[body]
        return Print(decal.picture, decal.pixel_mm, T @ decal.T_base_print, decal.y_up, decal.ink, decal.paper)

    # --- lens and sensor -----------------------------------------------------------------------------------------

    def _expose(self, picture: Image) -> Image:
        look = self._look
        if self._light is not None:
            picture = np.asarray(cv2.multiply(picture, self._light, dtype=cv2.CV_8U), np.uint8)
        if look.blur > 0.0:
            picture = np.asarray(cv2.GaussianBlur(picture, (5, 5), look.blur), np.uint8)
        if self._noise is not None:
            height, width = picture.shape[:2]
            y, x = (int(v) for v in self._noise_random.integers(0, 256, 2))
            noise = self._noise[y : y + height, x : x + width]
            picture = np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), np.uint8)
        return picture

    def _noise_bank(self) -> NDArray[np.int8] | None:
        """Noise for more than one picture; each takes its window at random."""
        if self._look.noise <= 0.0:
            return None
        random = np.random.default_rng([self._seed, 5])
        width, height = self.lens.size
        noise = random.standard_normal((height + 256, width + 256, 3), np.float32) * self._look.noise
        return np.asarray(np.clip(np.rint(noise), -127, 127), np.int8)


def _direction(azimuth: float, elevation: float) -> Array:
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])


def _rim(print_: Print) -> Array:
    """Points along the print's edge, (32, 3), close enough together to bound it in the picture."""
    corners = print_.corners
    share = np.arange(8)[:, None, None] / 8.0
    return np.asarray((corners * (1.0 - share) + np.roll(corners, -1, axis=0) * share).reshape(-1, 3))
