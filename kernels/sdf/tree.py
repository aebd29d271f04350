r"""A tree of boxes eight wide, for searches on a CPU: what it holds, and its refit as bodies move.

A node has up to eight children, and a leaf up to eight triangles. Their numbers lie side by side in vectors of eight
float32, so that loops over eight lanes become vector instructions; the searches are in tree_search.py. A GPU has a
point in each lane instead, and searches Warp's tree.

A triangle with corners a, b, c is also kept in a frame of its own, in which distances take a third of the operations:

    x̂ = (b - a)/l,   ŷ ⟂ x̂ in its plane,   ẑ = x̂ × ŷ;      a = (0, 0),   b = (l, 0),   c = (c_x, c_y),   l = |b - a|

| symbol | rows of `frames` |
| --- | --- |
| a; x̂, ŷ, ẑ | 0 to 2 [m]; 3 to 11 |
| l, c_x, c_y | 12, 13, 14 [m] |
| 1/|c - a|², 1/|c - b|² | 15, 16 [1/m²] |

The shape of the tree is found once, from one pose (tree_shape.py). A lane that is not used, and a triangle that is not
finite, is a point at `FAR`; a sliver has its corners but no frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_warp, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .tree_shape import LANES, shape_of

wp.set_module_options(compiling.options(max_unroll=1))

ROWS = 17
FAR = wp.constant(1.0e18)
"""Where nothing is [m]. Its square is finite, and no search reaches it."""
SLIVER = wp.constant(1.0e-6)
"""Least ratio of a triangle's doubled area to the sum of its squared edges, as in Warp's searches."""
vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec8i = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class Tree:
    """The trees of a packed batch of bodies as an argument of kernels; without nodes where Warp's trees are searched.

    Nodes and leaves are numbered by body. The children of a node follow each other, and have larger numbers than it.
    """

    nodes: wp.array[wp.int32]  # node at which each body begins, its root, and their number, [B + 1]
    children: wp.array[wp.int32]  # first child of each node, or ~leaf where they are leaves
    # of each node: lowest x, y, z and highest x, y, z of its children [m]
    boxes: wp.array2d[vec8]  # type: ignore[valid-type]
    # of each leaf, see the table above
    frames: wp.array2d[vec8]  # type: ignore[valid-type]
    # of each leaf: x, y, z of a, b, c [m]
    corners: wp.array2d[vec8]  # type: ignore[valid-type]
    # of each leaf, counted within the body; -1 in lanes that are not used
    faces: wp.array[vec8i]  # type: ignore[valid-type]


@wp.kernel(enable_backward=False)
def place_leaves(
    from_row: wp.int32,
    # Model:
    body_faces: wp.array[wp.vec3i],
    faces: wp.array[vec8i],
    first_face: wp.array[wp.int32],
    places: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    # Out:
    corners: wp.array2d[vec8],
    frames: wp.array2d[vec8],
    boxes: wp.array3d[wp.float32],
):
    """Corners and frames of the triangles of a leaf, and its box in its node."""
    thread, _ = wp.tid()  # see compiling.py
    leaf = from_row + thread
    ax, ay, az = vec8(FAR), vec8(FAR), vec8(FAR)
    bx, by, bz = vec8(FAR), vec8(FAR), vec8(FAR)
    cx, cy, cz = vec8(FAR), vec8(FAR), vec8(FAR)
    low = wp.vec3(FAR)
    high = wp.vec3(-FAR)
    for r in range(8):
        face = faces[leaf][r]
        if face >= 0:
            corner = body_faces[face + first_face[leaf]]
            a = vertices[corner[0]]
            b = vertices[corner[1]]
            c = vertices[corner[2]]
            if wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c) < FAR * FAR:  # neither NaN nor infinite
                low = wp.min(low, wp.min(a, wp.min(b, c)))
                high = wp.max(high, wp.max(a, wp.max(b, c)))
                ax[r] = a[0]
                ay[r] = a[1]
                az[r] = a[2]
                bx[r] = b[0]
                by[r] = b[1]
                bz[r] = b[2]
                cx[r] = c[0]
                cy[r] = c[1]
                cz[r] = c[2]
    for k in range(3):
        boxes[places[leaf] / 8, k, places[leaf] % 8] = low[k]
        boxes[places[leaf] / 8, k + 3, places[leaf] % 8] = high[k]
    corners[leaf, 0] = ax
    corners[leaf, 1] = ay
    corners[leaf, 2] = az
    corners[leaf, 3] = bx
    corners[leaf, 4] = by
    corners[leaf, 5] = bz
    corners[leaf, 6] = cx
    corners[leaf, 7] = cy
    corners[leaf, 8] = cz
    place_frames(frames, leaf, ax, ay, az, bx, by, bz, cx, cy, cz)


@wp.func
def place_frames(
    frames: wp.array2d[vec8],
    leaf: int,
    ax: vec8,
    ay: vec8,
    az: vec8,
    bx: vec8,
    by: vec8,
    bz: vec8,
    cx: vec8,
    cy: vec8,
    cz: vec8,
):
    """The frames of eight triangles, lane by lane. The axis y is made orthogonal twice, for slender triangles."""
    ox, oy, oz = vec8(), vec8(), vec8()
    xx, xy, xz = vec8(), vec8(), vec8()
    yx, yy, yz = vec8(), vec8(), vec8()
    zx, zy, zz = vec8(), vec8(), vec8()
    length, along, across = vec8(), vec8(), vec8()
    to_a, to_b = vec8(), vec8()
    r = wp.int32(0)
    while r < 8:
        ex = bx[r] - ax[r]
        ey = by[r] - ay[r]
        ez = bz[r] - az[r]
        fx = cx[r] - ax[r]
        fy = cy[r] - ay[r]
        fz = cz[r] - az[r]
        nx = ey * fz - ez * fy
        ny = ez * fx - ex * fz
        nz = ex * fy - ey * fx
        ee = ex * ex + ey * ey + ez * ez
        ff = fx * fx + fy * fy + fz * fz
        size = 2.0 * (ee + ff - (ex * fx + ey * fy + ez * fz))
        has_area = wp.sqrt(nx * nx + ny * ny + nz * nz) > SLIVER * size
        l = wp.where(has_area, wp.sqrt(ee), 1.0)
        x0 = wp.where(has_area, ex / l, 1.0)
        x1 = wp.where(has_area, ey / l, 0.0)
        x2 = wp.where(has_area, ez / l, 0.0)
        d = fx * x0 + fy * x1 + fz * x2
        y0 = wp.where(has_area, fx - d * x0, 0.0)
        y1 = wp.where(has_area, fy - d * x1, 1.0)
        y2 = wp.where(has_area, fz - d * x2, 0.0)
        d = 1.0 / wp.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
        y0 = y0 * d
        y1 = y1 * d
        y2 = y2 * d
        d = y0 * x0 + y1 * x1 + y2 * x2
        y0 = y0 - d * x0
        y1 = y1 - d * x1
        y2 = y2 - d * x2
        d = 1.0 / wp.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
        y0 = y0 * d
        y1 = y1 * d
        y2 = y2 * d
        u = wp.where(has_area, fx * x0 + fy * x1 + fz * x2, 0.0)
        v = wp.where(has_area, fx * y0 + fy * y1 + fz * y2, 0.0)
        l = wp.where(has_area, l, 0.0)
        ox[r] = wp.where(has_area, ax[r], FAR)
        oy[r] = wp.where(has_area, ay[r], FAR)
        oz[r] = wp.where(has_area, az[r], FAR)
        xx[r] = x0
        xy[r] = x1
        xz[r] = x2
        yx[r] = y0
        yy[r] = y1
        yz[r] = y2
        zx[r] = x1 * y2 - x2 * y1
        zy[r] = x2 * y0 - x0 * y2
        zz[r] = x0 * y1 - x1 * y0
        length[r] = l
        along[r] = u
        across[r] = v
        to_a[r] = wp.where(has_area, 1.0 / wp.where(has_area, u * u + v * v, 1.0), 0.0)
        to_b[r] = wp.where(has_area, 1.0 / wp.where(has_area, (u - l) * (u - l) + v * v, 1.0), 0.0)
        r += 1
    frames[leaf, 0] = ox
    frames[leaf, 1] = oy
    frames[leaf, 2] = oz
    frames[leaf, 3] = xx
    frames[leaf, 4] = xy
    frames[leaf, 5] = xz
    frames[leaf, 6] = yx
    frames[leaf, 7] = yy
    frames[leaf, 8] = yz
    frames[leaf, 9] = zx
    frames[leaf, 10] = zy
    frames[leaf, 11] = zz
    frames[leaf, 12] = length
    frames[leaf, 13] = along
    frames[leaf, 14] = across
    frames[leaf, 15] = to_a
    frames[leaf, 16] = to_b


@wp.kernel(enable_backward=False)
def join_boxes(
    from_row: wp.int32,
    # Model:
    nodes: wp.array[wp.int32],
    places: wp.array[wp.int32],
    # Out:
    boxes: wp.array3d[wp.float32],  # those of leaves are given
):
    """Boxes of the nodes of a body in their parents, from the leaves up."""
    thread, _ = wp.tid()  # see compiling.py
    b = from_row + thread
    for k in range(nodes[b + 1] - nodes[b] - 1):
        node = nodes[b + 1] - 1 - k
        place = places[node]
        for axis in range(3):
            low = boxes[node, axis, 0]
            high = boxes[node, axis + 3, 0]
            for r in range(1, 8):
                low = wp.min(low, boxes[node, axis, r])
                high = wp.max(high, boxes[node, axis + 3, r])
            boxes[place / 8, axis, place % 8] = low
            boxes[place / 8, axis + 3, place % 8] = high


class Trees:
    """The trees of a packed batch of bodies on a CPU.

    Args:
        vertices: Positions [m], float32 [U, 3], finite; this memory is read at each refit.
        faces: Packed vertex indices, int32 [G, 3].
        face_starts: Index at which the faces of each body begin, and G, [B + 1].

    Attributes:
        model: Argument of kernels, over the memory of this object.
    """

    def __init__(self, vertices: torch.Tensor, faces: torch.Tensor, face_starts: list[int]) -> None:
        centres = vertices[faces.long()].mean(dim=1).numpy()
        shape = shape_of(centres, face_starts)
        leaves, nodes, self._bodies = len(shape.leaf_places), len(shape.children), len(face_starts) - 1
        within = np.where(shape.faces < 0, -1, shape.faces - shape.first_face[:, None])
        self._boxes = torch.empty((nodes, 6, LANES))
        self._boxes[:, :3], self._boxes[:, 3:] = FAR, -FAR
        tensors: dict[str, tuple[torch.Tensor, Any]] = {
            "nodes": (torch.from_numpy(shape.nodes), wp.int32),
            "children": (torch.from_numpy(shape.children), wp.int32),
            "boxes": (self._boxes, vec8),
            "frames": (allocate((leaves, ROWS, LANES), torch.float32, vertices.device), vec8),
            "corners": (allocate((leaves, 9, LANES), torch.float32, vertices.device), vec8),
            "faces": (torch.from_numpy(within), vec8i),
        }
        self.model = Tree()
        for name, (tensor, kind) in tensors.items():
            setattr(self.model, name, as_warp(tensor, kind))
        own = as_warp(self._boxes, wp.float32)
        first, at, above = (
            as_warp(torch.from_numpy(values), wp.int32)
            for values in (shape.first_face, shape.leaf_places, shape.node_places)
        )
        corners, places = as_warp(faces, wp.vec3i), as_warp(vertices, wp.vec3)
        self._of_leaves = [corners, self.model.faces, first, at, places], [self.model.corners, self.model.frames, own]
        self._of_nodes = [self.model.nodes, above], [own]
        self._memory = tensors, shape
        self.refit()

    def refit(self) -> None:
        """Follows the vertices."""
        leaves = self.model.faces.shape[0]
        with torch_stream(torch.device("cpu")) as device:
            launch_rows(place_leaves, leaves, *self._of_leaves, device)
            launch_rows(join_boxes, self._bodies, *self._of_nodes, device, least=8)


def no_trees(device: torch.device) -> Tree:
    """The argument of kernels on a device where Warp's trees are searched."""
    model = Tree()
    for name, kind, dimensions in (
        ("nodes", wp.int32, 1), ("children", wp.int32, 1), ("boxes", vec8, 2), ("frames", vec8, 2),
        ("corners", vec8, 2), ("faces", vec8i, 1),
    ):  # fmt: skip
        setattr(model, name, wp.empty((0,) * dimensions, dtype=kind, device=str(device)))
    return model
