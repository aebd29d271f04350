"""Bodies: checked, their trees built once, refitted as they move, queried for closest points.

There is one tree per body, since a point of one garment must not see another garment's body: that of tree.py on a CPU,
of a `wp.Mesh` on a GPU and for bodies in pieces, whose signs are sums of solid angles. Vertices and faces are packed as
in all kernels, which get the memory of all bodies as one argument. The kernels of the queries are in closest.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from warpgarment.kernels import kept
from warpgarment.kernels.launch import as_warp, expect, launch, torch_stream
from warpgarment.kernels.mesh.caps import caps_of, joined
from warpgarment.kernels.replay.recording import also

from . import inside, nearest_face
from .closest import query_bodies
from .inside import loop_size_kernel
from .model import Bodies
from .tree import Trees, no_trees

LEAF_SIZE = 2
"""Number of faces in a leaf of a hierarchy: 1, 2, 4 and 8 take 2.50, 2.33, 2.37 and 2.58 ms for 1,836 points on a
CPU."""


class BodyQuery(NamedTuple):
    """Closest points of bodies, for N points.

    Where there is no closest point (the point is not finite, or no face of its body has an area), the distance and the
    position are NaN and the face is -1.
    """

    distance: torch.Tensor
    """Signed distance [m], float32 [N]; negative inside. Infinite beyond `within`, where `closest` is NaN and `face`
    -1."""
    closest: torch.Tensor
    """Nearest surface point [m], float32 [N, 3]."""
    face: torch.Tensor
    """Packed index of the nearest face, int32 [N]."""


class BodyMeshes:
    """A packed batch of bodies, prepared for queries of closest points.

    Args:
        vertices: Positions [m], float32 [U, 3]; they are copied.
        faces: Packed (global) vertex indices, int32 [G, 3]; they are copied.
        vertex_offsets: Index at which the vertices of each body begin, and U, integers [B + 1]; None for one body.
        face_offsets: Index at which the faces of each body begin, and G, integers [B + 1]; None for one body.
        wide: Whether nearest faces and rays are searched in trees eight wide, which works on a CPU only, or in Warp's;
            None: on a CPU. Both find the same.

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
        *,
        wide: bool | None = None,
    ) -> None:
        expect("body vertices", vertices, (None, 3))
        expect("body faces", faces, (None, 3), torch.int32, vertices.device)
        if (vertex_offsets is None) != (face_offsets is None):
            raise ValueError("give both vertex_offsets and face_offsets, or neither for a single body")
        starts = _offsets("vertex_offsets", vertex_offsets, len(vertices))
        face_starts = _offsets("face_offsets", face_offsets, len(faces))
        if len(starts) != len(face_starts):
            raise ValueError(f"vertex_offsets names {len(starts) - 1} bodies, face_offsets {len(face_starts) - 1}")
        _check(vertices, faces, starts, face_starts)

        self.count = len(starts) - 1
        self._vertices = vertices.detach().clone(memory_format=torch.contiguous_format)
        self._faces = faces.detach().clone(memory_format=torch.contiguous_format)
        first, parts = _topologies(self._faces.cpu().numpy(), starts, face_starts)
        caps_of_part, rings = {}, {}
        for b, (part, count) in parts.items():
            caps_of_part[b] = kept.of("caps", (part, count), partial(caps_of, part, count))
            rings[b] = kept.of("rings", (part,), partial(nearest_face.rings_of, part))
        caps = joined([caps_of_part[b] for b in first], starts)
        ring_starts = dict(zip(rings, np.cumsum([0, *map(len, rings.values())]).tolist(), strict=False))
        many = [int(caps.loops[b] - caps.loops[a]) > inside.MOST_CAPS for a, b in pairwise(caps.bodies.tolist())]
        wide = vertices.device.type == "cpu" if wide is None else wide
        self._meshes: dict[int, wp.Mesh] = {}  # where they are searched
        with torch_stream(vertices.device):
            for b in range(self.count):
                if not wide or many[b]:
                    points = as_warp(self._vertices[starts[b] : starts[b + 1]], wp.vec3)
                    triangles = as_warp(torch.from_numpy(parts[first[b]][0]).flatten().to(vertices.device), wp.int32)
                    self._meshes[b] = wp.Mesh(
                        points, triangles, support_winding_number=many[b], bvh_leaf_size=LEAF_SIZE
                    )

        def integers(values: Any, dtype: torch.dtype = torch.int32) -> torch.Tensor:
            return torch.as_tensor(values, dtype=dtype).to(vertices.device)

        meshes = [self._meshes[b].id if b in self._meshes else 0 for b in range(self.count)]
        self.mesh_ids = integers(meshes, torch.int64)
        self.face_offsets = integers(face_starts)
        self.model = Bodies()
        tensors = {
            "meshes": (self.mesh_ids, wp.uint64),
            "face_offsets": (self.face_offsets, wp.int32),
            "faces": (self._faces, wp.vec3i),
            "vertices": (self._vertices, wp.vec3),
            "rings": (integers(np.concatenate(list(rings.values()))), wp.int32),
            "ring_offsets": (integers([ring_starts[b] for b in first]), wp.int32),
            "scattered": (integers(many), wp.int32),
            "loop_offsets": (integers(caps.bodies), wp.int32),
            "loops": (integers(caps.loops), wp.int32),
            "caps": (integers(caps.triangles), wp.vec3i),
            "loop_size": (self._vertices.new_zeros((len(caps.loops) - 1, 2)), wp.vec2),
        }
        for name, (tensor, kind) in tensors.items():
            setattr(self.model, name, as_warp(tensor, kind))
        self._memory = tensors
        self._trees = Trees(self._vertices, self._faces, face_starts) if wide else None
        self.model.tree = self._trees.model if self._trees else no_trees(vertices.device)
        self.argument: wp.array = wp.array([self.model], dtype=Bodies, device=str(vertices.device))
        """Argument of kernels: arrays over the memory of this object, which must outlive their launches."""
        self._measure_loops()

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
        """Device of the bodies."""
        return self._vertices.device

    def update(self, vertices: torch.Tensor) -> None:
        """Moves the bodies: copies the positions and refits the hierarchies (cheaper than building, and as accurate).

        Args:
            vertices: New positions [m], float32 [U, 3]. They are not checked for NaN, which would stall a GPU in every
                frame; queries ignore faces with such corners or return NaN for them.
        """
        expect("body vertices", vertices, tuple(self._vertices.shape), device=self.device)
        self._vertices.copy_(vertices.detach())
        with torch_stream(self.device):
            for mesh in self._meshes.values():
                also(mesh.refit)
        if self._trees:
            self._trees.refit()
        self._measure_loops()

    def _measure_loops(self) -> None:
        loops = len(self.model.loops) - 1
        if loops:
            with torch_stream(self.device) as device:
                inputs = [self.model.caps, self.model.loops, self.model.vertices]
                launch(loop_size_kernel, loops, [*inputs, self.model.loop_size], device)

    def body_of(self, name: str, body: torch.Tensor | None, rows: int) -> torch.Tensor:
        """The body of each of several points, int32 [rows].

        Args:
            name: Name of the argument `body`, for error messages.
            body: Body of each point, int32 [rows]; None if there is one body.
            rows: Number of points.

        Raises:
            TypeError: Wrong dtype.
            ValueError: Wrong shape or device, or None although there are several bodies.
        """
        if body is None:
            if self.count != 1:
                raise ValueError(f"{name} is needed to choose among {self.count} bodies")
            return torch.zeros(rows, dtype=torch.int32, device=self.device)
        expect(name, body, (rows,), torch.int32, self.device)
        return body

    def query(
        self,
        points: torch.Tensor,
        body: torch.Tensor | None = None,
        *,
        within: float | torch.Tensor = float("inf"),
        clear: torch.Tensor | None = None,
    ) -> BodyQuery:
        """Signed distances and closest points, without gradients (see `sdf.signed_distance` for those).

        Args:
            points: Positions [m], float32 [N, 3].
            body: Body of each point, int32 [N]; None if there is one body.
            within: Distance [m], a number or float32 [N]. For points outside that are at least this far from the body
                the search stops early and the distance is infinite, which is many times faster. Points inside get an
                answer at any depth.
        clear: Radius of a ball around each point that is known to hold no surface, as `vertex_depth.Measured` has
            it [m], float32 [N]. It changes the time only.
        """
        expect("points", points, (None, 3), device=self.device)
        body = self.body_of("body", body, len(points))
        if isinstance(within, torch.Tensor):
            expect("within", within, (len(points),), device=self.device)
        else:
            within = torch.full((1,), within, device=self.device)
        if clear is not None:
            expect("clear", clear, (len(points),), device=self.device)
        distance, closest, face, _ = query_bodies(self.argument, points.detach(), body, within, clear)
        return BodyQuery(distance, closest, face)


def _offsets(name: str, offsets: torch.Tensor | Sequence[int] | None, total: int) -> list[int]:
    if offsets is None:
        return [0, total]
    values = [int(n) for n in (offsets.tolist() if isinstance(offsets, torch.Tensor) else offsets)]
    if len(values) < 2 or values[0] != 0 or values[-1] != total or any(a > b for a, b in pairwise(values)):
        raise ValueError(f"{name} must rise from 0 to {total}, one entry per body and the end; got {values[:8]}")
    return values


def _topologies(
    faces: np.ndarray, starts: list[int], face_starts: list[int]
) -> tuple[list[int], dict[int, tuple[np.ndarray, int]]]:
    """For each body the first one with the same faces; of these, faces as its own vertices, and number of vertices."""
    known: dict[tuple[bytes, int], int] = {}
    parts: dict[int, tuple[np.ndarray, int]] = {}
    first = []
    for b, (begin, end) in enumerate(pairwise(face_starts)):
        part, count = faces[begin:end] - np.int32(starts[b]), starts[b + 1] - starts[b]
        first.append(known.setdefault((part.tobytes(), count), b))
        if first[-1] == b:
            parts[b] = part, count
    return first, parts


def _check(vertices: torch.Tensor, faces: torch.Tensor, starts: list[int], face_starts: list[int]) -> None:
    """Refuses bodies that `wp.Mesh` must not get."""
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
