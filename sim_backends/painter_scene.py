"""Solids in flat arrays: moved, projected, sorted and outlined for all faces at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.lens import Lens
from sim_backends.solids import Array, Solid

# Bodies in contact overlap by less than this, mm.
_TOUCHING = -0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Face:
    """Walk around one face: rows of the samples on its rim, and the neighbour beyond each of them."""

    samples: NDArray[np.intp]
    neighbours: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """Where two faces meet: seen from outside, the first lies to the left of the way from start to end."""

    first: int
    second: int
    start: int
    end: int
    samples: NDArray[np.intp]  # the end excluded
    backwards: NDArray[np.intp]  # from the end, the start excluded


@dataclass(frozen=True, slots=True)
class View:
    """A scene as one camera sees it at one moment.

    Attributes:
        vertices: ndarray of shape (V, 3), `base`, mm.
        pixels: ndarray of shape (S, 2): every sample of every edge.
        normals: ndarray of shape (F, 3), outward.
        levels: ndarray of shape (F,): distance of each face's plane from the origin along its normal, mm.
        visible: ndarray of shape (F,), dtype bool: the face looks at the camera.
        inside: ndarray of shape (N,), dtype bool: the solid is at least partly in the picture.
        boxes: ndarray of shape (N, 4): x0, y0, x1, y1 of every solid in the picture.
        eye: ndarray of shape (3,): the camera, `base`, mm.
    """

    vertices: Array
    pixels: Array
    normals: Array
    levels: Array
    visible: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    boxes: Array
    eye: Array


class Scene:
    """The fixed structure of a set of solids; `view` fills it with a moment.

    Args:
        solids: What there is to see.
        bodies: Index of each solid's body in the positions and rotations handed to `move`.

    Attributes:
        local: ndarray of shape (V, 3): all vertices in their bodies' coordinates, mm.
        face_starts: Row of each solid's first face.
    """

    def __init__(self, solids: Sequence[Solid], bodies: Sequence[int]) -> None:
        self.solids = tuple(solids)
        counts = [len(s.vertices) for s in solids]
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        self.local = np.vstack([s.vertices for s in solids])
        self._body = np.repeat(np.asarray(bodies, np.intp), counts)
        self._edges: list[tuple[_Edge, ...]] = []
        self._faces: list[tuple[_Face, ...]] = []
        self.face_starts: list[int] = []
        corners: list[tuple[int, int, int]] = []
        start: list[int] = []
        end: list[int] = []
        share: list[float] = []
        sample_starts: list[int] = []
        for index, solid in enumerate(solids):
            base = int(self._starts[index])
            face0 = len(corners)
            self.face_starts.append(face0)
            sample_starts.append(len(start))
            corners += [(base + f[0], base + f[1], base + f[2]) for f in solid.faces]
            left = {(a, b): n for n, f in enumerate(solid.faces) for a, b in zip(f, (*f[1:], f[0]), strict=True)}
            edges: dict[tuple[int, int], _Edge] = {}
            for (a, b), number in left.items():
                if (b, a) in edges:
                    continue
                rows = np.arange(len(start), len(start) + solid.split + 1)
                edges[a, b] = _Edge(number + face0, left[b, a] + face0, a, b, rows[:-1], rows[:0:-1])
                start += [base + a] * len(rows)
                end += [base + b] * len(rows)
                share += [k / solid.split for k in range(len(rows))]
            self._edges.append(tuple(edges.values()))
            self._faces.append(tuple(_walk(face, edges, left, face0) for face in solid.faces))
        self._corners = np.array(corners, np.intp)
        self._start, self._end = np.array(start, np.intp), np.array(end, np.intp)
        self._share = np.array(share)[:, None]
        self._sample_starts = np.array(sample_starts, np.intp)

    def move(self, positions: Array, rotations: Array) -> Array:
        """Vertices (V, 3) in `base`, mm, of bodies at these poses."""
        return np.asarray(
            np.einsum("nij,nj->ni", rotations[self._body], self.local) + positions[self._body]
        )

    @property
    def vertex_count(self) -> int:
        """Vertices of all solids together."""
        return len(self.local)

    def vertices_of(self, index: int) -> slice:
        """Rows of the vertices of one solid."""
        return slice(int(self._starts[index]), int(self._starts[index + 1]))

    def view(self, vertices: Array, lens: Lens) -> View:
        """All solids projected and their faces oriented; nothing is sorted yet."""
        samples = vertices[self._start] * (1.0 - self._share) + vertices[self._end] * self._share
        pixels, ahead = lens.project(samples)
        a, b, c = (vertices[self._corners[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.sqrt((normals**2).sum(axis=1)), 1e-12)[:, None]
        levels = (normals * a).sum(axis=1)
        to_camera = normals @ lens.position - levels
        low = np.minimum.reduceat(pixels, self._sample_starts)
        high = np.maximum.reduceat(pixels, self._sample_starts)
        inside = (
            np.logical_and.reduceat(ahead, self._sample_starts)
            & (high > -1.0).all(axis=1)
            & (low < lens.size).all(axis=1)
        )
        boxes = np.hstack([low, high])
        return View(vertices, pixels, normals, levels, to_camera > 0.0, inside, boxes, lens.position)

    def outline(self, view: View, index: int) -> Array:
        """The closed contour (N, 2) of a solid in the picture, px."""
        visible = view.visible
        following: dict[int, tuple[NDArray[np.intp], int]] = {}
        for edge in self._edges[index]:
            first = visible[edge.first]
            if first == visible[edge.second]:
                continue
            if first:
                following[edge.start] = (edge.samples, edge.end)
            else:
                following[edge.end] = (edge.backwards, edge.start)
        if not following:
            return np.empty((0, 2))
        rows = []
        here = next(iter(following))
        for _ in range(len(following)):
            samples, here = following[here]
            rows.append(samples)
        return np.asarray(view.pixels[np.concatenate(rows)])

    def face(self, view: View, index: int, number: int) -> tuple[Array, NDArray[np.bool_]]:
        """Ring (N, 2) of a face in the picture, and which of its sides border on another visible face."""
        face = self._faces[index][number]
        return view.pixels[face.samples], view.visible[face.neighbours]

    def order(self, view: View, shown: NDArray[np.bool_]) -> tuple[int, ...]:
        """The solids marked in `shown`, a (N,) bool array, that are in the picture, far to near.

        A plane of a face that has another solid wholly on its outer side tells which of the two is in front.
        """
        chosen = np.flatnonzero(view.inside & shown)
        n = len(chosen)
        if n == 0:
            return ()
        b = view.boxes[chosen]
        centres = np.add.reduceat(view.vertices, self._starts[:-1])[chosen] / np.diff(self._starts)[chosen, None]
        distance = np.sqrt(((centres - view.eye) ** 2).sum(axis=1))
        behind: list[list[int]] = [[] for _ in range(n)]  # who must be painted before
        for i, j in zip(*np.nonzero(np.triu(meet(b, b), 1)), strict=True):
            first, second = int(chosen[i]), int(chosen[j])
            front = self._in_front(first, second, view)
            if front is None:
                front = second if distance[j] < distance[i] else first
            if front == first:
                behind[i].append(int(j))
            else:
                behind[j].append(int(i))
        out: list[int] = []
        state = [0] * n

        def paint(i: int) -> None:
            if state[i]:
                return
            state[i] = 1
            for j in behind[i]:
                paint(j)
            out.append(int(chosen[i]))

        for i in np.argsort(-distance, kind="stable"):
            paint(int(i))
        return tuple(out)

    def _in_front(self, first: int, second: int, view: View) -> int | None:
        for own, other in ((first, second), (second, first)):
            face0 = self.face_starts[own]
            faces = slice(face0, face0 + len(self.solids[own].faces))
            lowest = (view.normals[faces] @ view.vertices[self.vertices_of(other)].T).min(axis=1) - view.levels[faces]
            # The widest gap is the most trustworthy plane.
            best = int(lowest.argmax())
            if lowest[best] > _TOUCHING:
                return other if view.visible[face0 + best] else own
        return None


def meet(a: Array, b: Array) -> NDArray[np.bool_]:
    """Which boxes (x0, y0, x1, y1) of (N, 4) and (M, 4) overlap, shape (N, M); nan overlaps nothing."""
    return np.asarray(
        (a[:, None, 0] < b[None, :, 2])
        & (b[None, :, 0] < a[:, None, 2])
        & (a[:, None, 1] < b[None, :, 3])
        & (b[None, :, 1] < a[:, None, 3])
    )


def _walk(
    face: tuple[int, ...], edges: dict[tuple[int, int], _Edge], left: dict[tuple[int, int], int], face0: int
) -> _Face:
    rows, neighbours = [], []
    for a, b in zip(face, (*face[1:], face[0]), strict=True):
        samples = edges[a, b].samples if (a, b) in edges else edges[b, a].backwards
        rows.append(samples)
        neighbours += [left[b, a] + face0] * len(samples)
    return _Face(np.concatenate(rows), np.array(neighbours, np.intp))
