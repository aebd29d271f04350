"""Collisions between the layers of an outfit: vertices that have gone through, triangles that cross, depth.

Garments are open sheets, so winding numbers do not define an inside. A point lies *behind* a sheet if its closest point
is in the sheet's interior (not on its border), no further away than a reach, and the point is at the back of the
surface there, by the angle-weighted normal (Baerentzen and Aanaes 2005). Past the border, as for a coat longer than the
shirt below it, the two sides are not defined; beyond the reach, the point belongs to another part of the outfit.
"""

from __future__ import annotations

from collections.abc import Sequence

import igl
import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from warpgarment.kernels import launch  # noqa: F401  (quietens Warp)
from warpgarment.objects.garment import Garment

REACH = 0.03
_MILLIMETRES = wp.constant(wp.float64(1e3))


@wp.kernel(enable_backward=False)
def _count_crossings(
    # Mesh:
    other: wp.uint64,
    # In:
    points: wp.array[wp.vec3],
    triangles: wp.array2d[int],
    same: bool,
    # Out:
    count: wp.array[int],
):
    """Number of faces of `other` that each triangle crosses; with `same`, both are one mesh, and neighbours and pairs
    seen before do not count. Positions are in millimetres, because the test takes distance times area below 1e-6 for
    zero."""
    t = wp.tid()
    i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    a, b, c = points[i], points[j], points[k]
    query = wp.mesh_query_aabb(other, wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c))
    found = wp.int32(0)
    face = wp.int32(0)
    while wp.mesh_query_aabb_next(query, face):
        u = wp.mesh_get_index(other, 3 * face)
        v = wp.mesh_get_index(other, 3 * face + 1)
        w = wp.mesh_get_index(other, 3 * face + 2)
        if same:
            if face <= t or u == i or u == j or u == k or v == i or v == j or v == k or w == i or w == j or w == k:
                continue
        mesh = wp.mesh_get(other)
        found += wp.intersect_tri_tri(
            wp.vec3d(a) * _MILLIMETRES,
            wp.vec3d(b) * _MILLIMETRES,
            wp.vec3d(c) * _MILLIMETRES,
            wp.vec3d(mesh.points[u]) * _MILLIMETRES,
            wp.vec3d(mesh.points[v]) * _MILLIMETRES,
            wp.vec3d(mesh.points[w]) * _MILLIMETRES,
        )
    count[t] = found


class Sheet:
    """The connectivity of an open surface, prepared for queries about many of its shapes.

    Args:
        faces: Vertex indices, counter-clockwise seen from outside, shape [F, 3].
    """

    def __init__(self, faces: np.ndarray):
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        edges = np.sort(self.faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)  # edge k is opposite to corner k
        self.edges, edge_of, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        self._border_edge = (uses == 1)[edge_of.reshape(-1)].reshape(-1, 3)
        on_border = np.zeros(self.faces.max() + 1, bool)
        on_border[self.edges[uses == 1]] = True
        self._border_corner = on_border[self.faces]
        self._triangles: wp.array = wp.array(self.faces.astype(np.int32), dtype=int, device="cpu")
        self._mesh: wp.Mesh | None = None

    def locate(self, vertices: np.ndarray, points: np.ndarray) -> Located:
        """Positions of points relative to the sheet.

        Args:
            vertices: Vertices of the sheet [m], shape [V, 3].
            points: Points [m], shape [N, 3].
        """
        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        sign = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        distance, face, closest, normal = igl.signed_distance(
            np.ascontiguousarray(points, dtype=np.float64), vertices, self.faces, sign_type=sign
        )
        corners = vertices[self.faces[face]]
        weights = np.asarray(igl.barycentric_coordinates(closest, corners[:, 0], corners[:, 1], corners[:, 2]))
        weights = weights.reshape(-1, 3)
        border = ((weights < 1e-6) & self._border_edge[face]).any(1)
        border |= ((weights > 1 - 1e-6) & self._border_corner[face]).any(1)
        return Located(distance, np.asarray(face), closest, normal, weights, ~border)

    def crossings(self, vertices: np.ndarray, other: Sheet, other_vertices: np.ndarray) -> np.ndarray:
        """Number of faces of another sheet that each face crosses, int [F]; faces that touch count.

        Args:
            vertices: Vertices of this sheet [m], shape [V, 3].
            other: The other sheet.
            other_vertices: Vertices of the other sheet [m], shape [W, 3].
        """
        return other._crossed_by(other_vertices, self._triangles, vertices, same=False)

    def self_crossings(self, vertices: np.ndarray) -> np.ndarray:
        """Number of later faces without a common vertex that each face crosses, int [F]; vertices [m] are [V, 3]."""
        return self._crossed_by(vertices, self._triangles, vertices, same=True)

    def gap_to(self, vertices: np.ndarray, other: Sheet, other_vertices: np.ndarray) -> float:
        """Least distance to another sheet that this one does not cross [m]: vertex to face, both ways, or edge to edge.

        Arguments are those of :meth:`crossings`.
        """
        a, b = (np.ascontiguousarray(v, dtype=np.float64) for v in (vertices, other_vertices))
        gap = min(
            np.sqrt(igl.point_mesh_squared_distance(a, b, other.faces)[0].min()),
            np.sqrt(igl.point_mesh_squared_distance(b, a, self.faces)[0].min()),
        )
        ends_a, ends_b = a[self.edges], b[other.edges]
        half_a, half_b = (0.5 * np.linalg.norm(e[:, 1] - e[:, 0], axis=1).max() for e in (ends_a, ends_b))
        near = cKDTree(ends_a.mean(1)).query_ball_point(ends_b.mean(1), half_a + half_b + gap)
        j = np.repeat(np.arange(len(near)), [len(n) for n in near])
        i = np.concatenate([np.asarray(n, dtype=int) for n in near])
        return float(min(gap, _segment_distance(ends_a[i], ends_b[j]).min(initial=np.inf)))

    def _crossed_by(self, vertices: np.ndarray, triangles: wp.array, points: np.ndarray, same: bool) -> np.ndarray:
        placed = np.ascontiguousarray(vertices, dtype=np.float32)
        if self._mesh is None:
            self._mesh = wp.Mesh(wp.array(placed, dtype=wp.vec3, device="cpu"), self._triangles.flatten())
        else:
            self._mesh.points.assign(placed)
            self._mesh.refit()
        count = wp.zeros(len(triangles), dtype=int, device="cpu")
        moved: wp.array[wp.vec3] = wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3, device="cpu")
        inputs = [self._mesh.id, moved, triangles, same]
        wp.launch(_count_crossings, dim=len(triangles), inputs=inputs, outputs=[count], device="cpu")
        return count.numpy()


def _segment_distance(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Distances between pairs of segments [N, 2, 3] whose closest points both lie inside; otherwise infinity, [N]."""
    u, v, w = p[:, 1] - p[:, 0], q[:, 1] - q[:, 0], p[:, 0] - q[:, 0]
    uu, uv, vv, uw, vw = (np.einsum("nc,nc->n", x, y) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (uv * vw - vv * uw) / area, (uu * vw - uv * uw) / area
    inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    apart = np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)
    return np.where(inside, apart, np.inf)


class Located:
    """Positions of points relative to a sheet, as arrays with one entry per point.

    Attributes:
        distance: Signed distance, negative behind the sheet [m], shape [N].
        face: Nearest face, shape [N].
        closest: Closest point of the sheet [m], shape [N, 3].
        normal: Angle-weighted normal at the closest point, shape [N, 3].
        weights: Barycentric coordinates of the closest point, shape [N, 3].
        interior: Whether the closest point is off the border, so that the sign is defined, bool [N].
    """

    def __init__(
        self,
        distance: np.ndarray,
        face: np.ndarray,
        closest: np.ndarray,
        normal: np.ndarray,
        weights: np.ndarray,
        interior: np.ndarray,
    ) -> None:
        self.distance, self.face, self.closest = distance, face, closest
        self.normal, self.weights, self.interior = normal, weights, interior

    def behind(self, reach: float = REACH) -> np.ndarray:
        """Whether a point lies behind the sheet, at most `reach` [m] from it, bool [N]."""
        return self.interior & (self.distance < 0) & (self.distance > -reach)

    def beyond(self, reach: float = REACH) -> np.ndarray:
        """Whether a point lies in front of the sheet, at most `reach` [m] from it, bool [N]."""
        return self.interior & (self.distance > 0) & (self.distance < reach)


class LayerFigures:
    """Figures of an outfit, frame by frame.

    Args:
        garments: Garments, innermost first.
        reach: Largest distance at which a vertex counts as gone through [m].
    """

    def __init__(self, garments: Sequence[Garment], reach: float = REACH):
        self._sheets = [Sheet(garment.faces) for garment in garments]
        self._reach = reach

    def measure(self, vertices: Sequence[np.ndarray]) -> dict[str, float]:
        """Figures of one frame.

        Args:
            vertices: Vertices of each garment [m], shape [V, 3].

        Returns:
            `layer_inside`: share of the vertices of all outer garments that are behind any inner one; `layer_inside_K`:
            this share for garment K alone, K = 1 being the second. `layer_crossings`: number of pairs of triangles of
            different garments that cross. `layer_depth`: largest distance by which a vertex has gone through [m], an
            outer vertex behind an inner garment or, next to a crossing, an inner vertex in front of an outer garment;
            only garments that cross count, as others are behind each other only around a border. A single garment has
            no figures.

        Raises:
            ValueError: The number of arrays is not that of the garments.
        """
        if len(vertices) != len(self._sheets):
            raise ValueError(f"{len(self._sheets)} garments have been announced, {len(vertices)} are given")
        if len(vertices) < 2:
            return {}
        if not all(np.isfinite(v).all() for v in vertices):
            names = ["layer_inside", *(f"layer_inside_{k}" for k in range(1, len(vertices)))]
            return dict.fromkeys([*names, "layer_crossings", "layer_depth"], float("nan"))
        figures, counts, crossings, depth = {}, [], 0, 0.0
        for k in range(1, len(self._sheets)):
            inside = np.zeros(len(vertices[k]), bool)
            for n in range(k):
                outer, inner = self._sheets[k], self._sheets[n]
                located = inner.locate(vertices[n], vertices[k])
                behind = located.behind(self._reach)
                inside |= behind
                crossed = inner.crossings(vertices[n], outer, vertices[k])
                if crossed.any():
                    crossings += int(crossed.sum())
                    depth = max(depth, -located.distance[behind].min(initial=0.0))
                    poking = np.unique(inner.faces[crossed > 0])  # away from crossings, sleeves hang in front of layers
                    located = outer.locate(vertices[k], vertices[n][poking])
                    depth = max(depth, located.distance[located.beyond(self._reach)].max(initial=0.0))
            figures[f"layer_inside_{k}"] = float(inside.mean())
            counts.append((inside.sum(), len(inside)))
        through, total = np.sum(counts, axis=0)
        return {
            "layer_inside": float(through / total),
            **figures,
            "layer_crossings": float(crossings),
            "layer_depth": float(depth),
        }
