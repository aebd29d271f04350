"""Bodies as Warp meshes: checked, built once, refitted as they move, asked for closest points.

One `wp.Mesh` per body, since a point of one garment must not see another's body. Vertices and faces are packed like
everything else; the ids of the meshes travel to the kernel as an array that is indexed by the body of each point.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
import warp as wp

from ._operator import row_operator
from ._torch import as_warp, expect, torch_stream

MAX_DISTANCE = wp.constant(1.0e18)  # farther than anything; its square still fits a float32
# Distance, in radii, from which a group of faces is summed as one. On closed bodies 1, 2 and 3 give the same signs
# (20,000 points); at the mouths of open ones, signs are sure where the winding number is 0.04, 0.001 and less from 0.5.
WINDING_ACCURACY = wp.constant(2.0)
INSIDE = wp.constant(0.5)  # winding number of the boundary: closed surfaces have 0 outside and 1 or more inside


@wp.func
def closest_on_body(mesh: wp.uint64, point: wp.vec3):
    """Nearest surface point of a body by its winding number.

    Returns:
        Local face index (-1: nothing found), sign (+1 outside, -1 inside), barycentric coordinates, closest point.
    """
    query = wp.mesh_query_point_sign_winding_number(mesh, point, MAX_DISTANCE, WINDING_ACCURACY, INSIDE)
    if not query.result:
        return -1, 1.0, wp.vec3(wp.nan), wp.vec3d(wp.float64(wp.nan))
    body = wp.mesh_get(mesh)
    weights = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
    a = wp.vec3d(body.points[body.indices[3 * query.face]])
    b = wp.vec3d(body.points[body.indices[3 * query.face + 1]])
    c = wp.vec3d(body.points[body.indices[3 * query.face + 2]])
    closest = a * wp.float64(weights[0]) + b * wp.float64(weights[1]) + c * wp.float64(weights[2])
    return query.face, query.sign, weights, closest


@wp.kernel(enable_backward=False)
def query_bodies_kernel(
    # Model:
    meshes: wp.array[wp.uint64],
    face_offsets: wp.array[wp.int32],
    # In:
    points: wp.array[wp.vec3],
    body_of_point: wp.array[wp.int32],
    # Out:
    distance: wp.array[wp.float32],
    closest: wp.array[wp.vec3],
    face: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3],
):
    i = wp.tid()
    b = body_of_point[i]
    distance[i] = wp.nan
    closest[i] = wp.vec3(wp.nan)
    face[i] = -1
    barycentric[i] = wp.vec3(wp.nan)
    if b < 0 or b >= meshes.shape[0]:
        return
    found, sign, weights, position = closest_on_body(meshes[b], points[i])
    if found < 0:
        return
    distance[i] = sign * wp.float32(wp.length(wp.vec3d(points[i]) - position))
    closest[i] = wp.vec3(position)
    face[i] = found + face_offsets[b]
    barycentric[i] = weights


query_bodies = row_operator(
    "query_bodies",
    query_bodies_kernel,
    {"meshes": wp.uint64, "face_offsets": wp.int32, "points": wp.vec3, "body_of_point": wp.int32},
    {
        "distance": (wp.float32, ()),
        "closest": (wp.vec3, (3,)),
        "face": (wp.int32, ()),
        "barycentric": (wp.vec3, (3,)),
    },
    rows="points",
)


class BodyQuery(NamedTuple):
    """Closest points of bodies.

    Where nothing was found (the point is not finite, or no face of its body has an area), the numbers are NaN and the
    face -1.
    """

    distance: torch.Tensor
    """Signed distance [m], float32 [N]; negative inside."""
    closest: torch.Tensor
    """Nearest surface point [m], float32 [N, 3]."""
    face: torch.Tensor
    """Packed index of the nearest face, int32 [N]."""


class BodyMeshes:
    """A packed batch of bodies, ready to be asked for closest points.

    Args:
        vertices: Positions [m], float32 [U, 3]. Copied.
        faces: Packed (global) vertex indices, int32 [G, 3].
        vertex_offsets: Where the vertices of each body begin, and the end, [B + 1]. None: one body.
        face_offsets: The same for faces, [B + 1]. None: one body.

    Raises:
        TypeError: Wrong dtypes.
        ValueError: Wrong shapes or offsets, a body without faces, a face that names a vertex its body does not have,
            vertices that are not finite. `wp.Mesh` would accept all of these and read outside its memory.
    """

    def __init__(
        self,
        vertices: torch.Tensor,
        faces: torch.Tensor,
        vertex_offsets: torch.Tensor | Sequence[int] | None = None,
        face_offsets: torch.Tensor | Sequence[int] | None = None,
    ) -> None:
        expect("body vertices", vertices, (None, 3))
        expect("body faces", faces, (None, 3), torch.int32, vertices.device)
        if (vertex_offsets is None) != (face_offsets is None):
            raise ValueError("give both vertex_offsets and face_offsets, or neither for a single body")
        starts = _offsets("vertex_offsets", vertex_offsets, len(vertices))
        face_starts = _offsets("face_offsets", face_offsets, len(faces))
        if len(starts) != len(face_starts):
            raise ValueError(f"vertex_offsets names {len(starts) - 1} bodies, face_offsets {len(face_starts) - 1}")
        first_vertex = _check(vertices, faces, starts, face_starts)

        self.count = len(starts) - 1
        self._vertices = vertices.detach().clone(memory_format=torch.contiguous_format)
        self._faces = faces.detach().clone(memory_format=torch.contiguous_format)
        local = self._faces - first_vertex[:, None]
        self._meshes: list[wp.Mesh] = []
        with torch_stream(vertices.device):
            for b in range(self.count):
                points = self._vertices[starts[b] : starts[b + 1]]
                indices = local[face_starts[b] : face_starts[b + 1]].reshape(-1)
                self._meshes.append(
                    wp.Mesh(as_warp(points, wp.vec3), as_warp(indices, wp.int32), support_winding_number=True)
                )
        self.mesh_ids = torch.tensor([mesh.id for mesh in self._meshes], dtype=torch.int64).to(vertices.device)
        self.face_offsets = torch.tensor(face_starts, dtype=torch.int32, device=vertices.device)

    @property
    def vertices(self) -> torch.Tensor:
        """Current positions [m], float32 [U, 3]; changed in place by `update`."""
        return self._vertices

    @property
    def faces(self) -> torch.Tensor:
        """Packed vertex indices, int32 [G, 3]."""
        return self._faces

    @property
    def device(self) -> torch.device:
        """Where the bodies live."""
        return self._vertices.device

    def update(self, vertices: torch.Tensor) -> None:
        """Moves the bodies: copies the positions and refits the hierarchies (cheaper than building, and as accurate).

        Args:
            vertices: New positions [m], float32 [U, 3]. They are not searched for NaN, which would stall a GPU every
                frame; faces with such corners are not found by queries, or answer NaN.
        """
        expect("body vertices", vertices, tuple(self._vertices.shape), device=self.device)
        self._vertices.copy_(vertices.detach())
        with torch_stream(self.device):
            for mesh in self._meshes:
                mesh.refit()

    def body_of(self, name: str, body: torch.Tensor | None, rows: int) -> torch.Tensor:
        """The body of each of `rows` points: as given, after a check, or the only one there is."""
        if body is None:
            if self.count != 1:
                raise ValueError(f"{name} is needed to choose among {self.count} bodies")
            return torch.zeros(rows, dtype=torch.int32, device=self.device)
        expect(name, body, (rows,), torch.int32, self.device)
        return body

    def query(self, points: torch.Tensor, body: torch.Tensor | None = None) -> BodyQuery:
        """Signed distances and closest points, without gradients (see `sdf.signed_distance` for those).

        Args:
            points: Positions [m], float32 [N, 3].
            body: Body of each point, int32 [N]; None if there is one body.
        """
        expect("points", points, (None, 3), device=self.device)
        body = self.body_of("body", body, len(points))
        distance, closest, face, _ = query_bodies(self.mesh_ids, self.face_offsets, points.detach(), body)
        return BodyQuery(distance, closest, face)


def _offsets(name: str, offsets: torch.Tensor | Sequence[int] | None, total: int) -> list[int]:
    if offsets is None:
        return [0, total]
    values = [int(n) for n in (offsets.tolist() if isinstance(offsets, torch.Tensor) else offsets)]
    if len(values) < 2 or values[0] != 0 or values[-1] != total or any(a > b for a, b in pairwise(values)):
        raise ValueError(f"{name} must rise from 0 to {total}, one entry per body and the end; got {values[:8]}")
    return values


def _check(vertices: torch.Tensor, faces: torch.Tensor, starts: list[int], face_starts: list[int]) -> torch.Tensor:
    """Refuses what `wp.Mesh` must not see. Returns the first vertex of the body of each face, int32 [G]."""
    sizes = [b - a for a, b in pairwise(face_starts)]
    empty = [b for b, size in enumerate(sizes) if size == 0]
    if empty:
        raise ValueError(f"{len(empty)} of {len(sizes)} bodies have no faces (first: body {empty[0]})")
    infinite = ~torch.isfinite(vertices).all(dim=1)
    if bool(infinite.any()):
        count, first = int(infinite.sum()), int(infinite.nonzero()[0])
        raise ValueError(f"{count} of {len(vertices)} body vertices are not finite (first: vertex {first})")
    repeats = torch.tensor(sizes, device=faces.device)
    low = torch.tensor(starts[:-1], dtype=torch.int32, device=faces.device).repeat_interleave(repeats)
    high = torch.tensor(starts[1:], dtype=torch.int32, device=faces.device).repeat_interleave(repeats)
    outside = ((faces < low[:, None]) | (faces >= high[:, None])).any(dim=1)
    if bool(outside.any()):
        count, first = int(outside.sum()), int(outside.nonzero()[0])
        raise ValueError(
            f"{count} of {len(faces)} body faces name vertices their body does not have (first: face {first}, "
            f"{faces[first].tolist()}, whose body has vertices {int(low[first])} to {int(high[first]) - 1})"
        )
    return low
