"""Solids in flat arrays: moved, projected, sorted and outlined for all faces at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backends.lens import Lens
from sim_backends.solids import Array, Solid


@dataclass(frozen=True, slots=True)
class _Edge:
    first: int  # face on whose left the edge runs from start to end
    second: int
    samples: slice  # rows of the sampled points, both ends included


@dataclass(frozen=True, slots=True)
class View:
    """A scene as one camera sees it at one moment.

    Attributes:
        vertices: ndarray of shape (V, 3), `base`, mm.
        pixels: ndarray of shape (S, 2): every sample of every edge.
        normals: ndarray of shape (F, 3), outward.
        visible: ndarray of shape (F,), dtype bool.
        order: Solids to be painted, far to near.
        boxes: ndarray of shape (N, 4): x0, y0, x1, y1 of every solid in the picture.
    """

    vertices: Array
    pixels: Array
    normals: Array
    visible: NDArray[np.bool_]
    order: tuple[int, ...]
    boxes: Array


class Scene:
    """The fixed structure of a set of solids; `view` fills it with a moment.

    Args:
        solids: What there is to see.
        bodies: Index of each solid's body in the positions and rotations handed to `view`.
    """

    def __init__(self, solids: Sequence[Solid], bodies: Sequence[int]) -> None:
        self.solids = tuple(solids)
        counts = [len(s.vertices) for s in solids]
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        self._local = np.vstack([s.vertices for s in solids])
        self._body = np.repeat(np.asarray(bodies, np.intp), counts)
        self._edges: list[tuple[_Edge, ...]] = []
        self._faces: list[list[list[tuple[int, bool]]]] = []  # solid, face: (edge, runs backwards)
        self.face_starts: list[int] = []
        corners: list[tuple[int, int, int]] = []
        start, end, share = [], [], []
        face_solid: list[int] = []
        for index, solid in enumerate(solids):
            base = int(self._starts[index])
            self.face_starts.append(len(corners))
            corners += [(base + f[0], base + f[1], base + f[2]) for f in solid.faces]
            face_solid += [index] * len(solid.faces)
            found: dict[tuple[int, int], int] = {}
            edges: list[_Edge] = []
            faces: list[list[tuple[int, bool]]] = []
            for number, face in enumerate(solid.faces):
                walk: list[tuple[int, bool]] = []
                for a, b in zip(face, (*face[1:], face[0]), strict=True):
                    if (b, a) in found:
                        edge = found[b, a]
                        edges[edge] = _Edge(edges[edge].first, number, edges[edge].samples)
                        walk.append((edge, True))
                        continue
                    found[a, b] = len(edges)
                    walk.append((len(edges), False))
                    samples = slice(len(start), len(start) + solid.split + 1)
                    edges.append(_Edge(number, -1, samples))
                    start += [base + a] * (solid.split + 1)
                    end += [base + b] * (solid.split + 1)
                    share += [k / solid.split for k in range(solid.split + 1)]
                faces.append(walk)
            self._edges.append(tuple(edges))
            self._faces.append(faces)
        self._corners = np.array(corners, np.intp)
        self._face_solid = np.array(face_solid, np.intp)
        self._start, self._end = np.array(start, np.intp), np.array(end, np.intp)
        self._share = np.array(share)[:, None]
        self._sample_starts = np.array([e[0].samples.start for e in self._edges], np.intp)

    def move(self, positions: Array, rotations: Array) -> Array:
        """Vertices (V, 3) in `base`, mm, of bodies at these poses."""
        return np.asarray(
            np.einsum("nij,nj->ni", rotations[self._body], self._local) + positions[self._body]
        )

    def vertices_of(self, index: int) -> slice:
        """Rows of the vertices of one solid."""
        return slice(int(self._starts[index]), int(self._starts[index + 1]))

    def view(self, vertices: Array, lens: Lens, shown: NDArray[np.bool_]) -> View:
        """Project and sort the solids marked in `shown`, a (N,) bool array."""
        samples = vertices[self._start] * (1.0 - self._share) + vertices[self._end] * self._share
        pixels, ahead = lens.project(samples)
        a, b, c = (vertices[self._corners[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        to_camera = ((lens.position - a) * normals).sum(axis=1)
        low = np.minimum.reduceat(pixels, self._sample_starts)
        high = np.maximum.reduceat(pixels, self._sample_starts)
        boxes = np.hstack([low, high])
        width, height = lens.size
        inside = (
            shown
            & np.logical_and.reduceat(ahead, self._sample_starts)
            & (high > -1.0).all(axis=1)
            & (low < (width, height)).all(axis=1)
        )
        chosen = np.flatnonzero(inside)
        order = self._order(chosen, vertices, a, normals, to_camera, boxes, lens)
        return View(vertices, pixels, normals, to_camera > 0.0, order, boxes)

    def outline(self, view: View, index: int) -> Array:
        """The closed contour (N, 2) of a solid in the picture, px."""
        face0 = self.face_starts[index]
        following: dict[bytes, Array] = {}
        pieces = []
        for edge in self._edges[index]:
            first, second = view.visible[face0 + edge.first], view.visible[face0 + edge.second]
            if first == second:
                continue
            points = view.pixels[edge.samples]
            if not first:
                points = points[::-1]
            pieces.append(points)
            following[points[0].tobytes()] = points
        if not pieces:
            return np.empty((0, 2))
        ring = [pieces[0][:-1]]
        here = pieces[0][-1].tobytes()
        for _ in range(len(pieces) - 1):
            piece = following[here]
            ring.append(piece[:-1])
            here = piece[-1].tobytes()
        return np.vstack(ring)

    def face(self, view: View, index: int, number: int) -> tuple[Array, NDArray[np.bool_]]:
        """Ring (N, 2) of a face in the picture, and which of its sides border on another visible face."""
        face0 = self.face_starts[index]
        ring, inner = [], []
        for edge_index, backwards in self._faces[index][number]:
            edge = self._edges[index][edge_index]
            points = view.pixels[edge.samples]
            points = points[:0:-1] if backwards else points[:-1]
            other = edge.first if backwards else edge.second
            ring.append(points)
            inner += [bool(view.visible[face0 + other])] * len(points)
        return np.vstack(ring), np.array(inner)

    def _order(
        self,
        chosen: NDArray[np.intp],
        vertices: Array,
        corners: Array,
        normals: Array,
        to_camera: Array,
        boxes: Array,
        lens: Lens,
    ) -> tuple[int, ...]:
        """Far to near. A plane of a face that has one solid wholly on its outer side tells which is in front."""
        n = len(chosen)
        if n == 0:
            return ()
        b = boxes[chosen]
        overlap = (
            (b[:, None, 0] < b[None, :, 2])
            & (b[None, :, 0] < b[:, None, 2])
            & (b[:, None, 1] < b[None, :, 3])
            & (b[None, :, 1] < b[:, None, 3])
        )
        np.fill_diagonal(overlap, False)
        centres = np.add.reduceat(vertices, self._starts[:-1]) / np.diff(self._starts)[:, None]
        distance = np.linalg.norm(centres[chosen] - lens.position, axis=1)
        behind: list[list[int]] = [[] for _ in range(n)]  # who must be painted before
        for i, j in zip(*np.nonzero(np.triu(overlap)), strict=True):
            first, second = int(chosen[i]), int(chosen[j])
            front = self._in_front(first, second, vertices, corners, normals, to_camera)
            if front is None:
                front = second if distance[j] < distance[i] else first
            if front == first:
                behind[i].append(j)
            else:
                behind[j].append(i)
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

    def _in_front(
        self, first: int, second: int, vertices: Array, corners: Array, normals: Array, to_camera: Array
    ) -> int | None:
        for own, other in ((first, second), (second, first)):
            faces = slice(self.face_starts[own], self.face_starts[own] + len(self.solids[own].faces))
            points = vertices[self.vertices_of(other)]
            heights = normals[faces] @ points.T - (normals[faces] * corners[faces]).sum(axis=1)[:, None]
            apart = heights.min(axis=1) > -0.3  # bodies in contact overlap by less than this, mm
            if apart.any():
                # The widest gap is the most trustworthy plane.
                best = int(np.argmax(np.where(apart, heights.min(axis=1), -np.inf)))
                return other if to_camera[faces][best] > 0.0 else own
        return None
