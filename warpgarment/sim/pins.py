"""Pins: garment vertices that keep their place on the body (waistbands, straps).

In the first frame the nearest body face of each pin is found, with the barycentric coordinates b of the nearest point
and the offset from it in the orthonormal frame [t, n x t, n] of the face, where t = e1/|e1|. (The offset is along the
normal n, unless the nearest point lies on an edge.) In every later frame

    target = sum_k b_k U_k + offset_1 t + offset_2 (n x t) + offset_3 n

so pins have their given positions in the first frame, and then depend on the body alone.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch

from warpgarment.kernels.mesh.laplacian import cotangent_laplacian
from warpgarment.kernels.sdf.bodies import BodyMeshes


class BodyPins:
    """Pins tied to the surface of packed bodies.

    Args:
        positions: Positions of the pinned vertices in the first frame [m], shape [P,3].
        bodies: The bodies in that frame.
        body_of_pin: Body of each pin, int32, shape [P].
    """

    def __init__(self, positions: torch.Tensor, bodies: BodyMeshes, body_of_pin: torch.Tensor) -> None:
        query = bodies.query(positions.contiguous(), body_of_pin)
        self.corners = bodies.faces[query.face.long()].long()  # [P,3]
        triangles = bodies.vertices[self.corners]
        self.barycentric = barycentric_coordinates(query.closest, triangles)
        foot = (self.barycentric[..., None] * triangles).sum(dim=1)
        self.offset = (_surface_frames(triangles).mT @ (positions - foot)[..., None]).squeeze(-1)

    def targets(self, body_vertices: torch.Tensor) -> torch.Tensor:
        """Positions of the pins for given positions of the bodies; [U,3] -> [P,3] in metres."""
        triangles = body_vertices[self.corners]
        foot = (self.barycentric[..., None] * triangles).sum(dim=1)
        return foot + (_surface_frames(triangles) @ self.offset[..., None]).squeeze(-1)


def mean_response(
    rest_vertices: np.ndarray, faces: np.ndarray, pins: np.ndarray, face_component: np.ndarray, stiffness: float = 1e3
) -> np.ndarray:
    """Displacement of a pinned garment per displacement of its mean: the field u of least energy with unit mean.

    Pins fix the translation of the Poisson solve, and the predicted velocity q would be lost. The minimiser of the same
    energy under the additional condition mean(V) = z + q is V_pinned + u (z + q - mean(V_pinned)), with

        u = (L + W)^-1 c / (c^T (L + W)^-1 c),        c: share of each vertex in the mean face centroid

    u is 0 at the pins and grows away from them. It is constant per garment.

    Args:
        rest_vertices: Rest positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        pins: Indices of pinned vertices, shape [P]; may be empty.
        face_component: Connected component of each face, shape [F].
        stiffness: Stiffness of a pin, in units of the mean diagonal entry of the Laplacian.

    Returns:
        u, float32 [V]; zero on components without pins.
    """
    response = np.zeros(len(rest_vertices), np.float32)
    if not len(pins):
        return response
    laplacian = cotangent_laplacian(rest_vertices, faces)
    diagonal = laplacian.diagonal()
    weight = np.zeros(len(rest_vertices))
    weight[pins] = stiffness * diagonal[diagonal > 0].mean()
    pinned = np.unique(face_component[np.isin(faces, pins).any(1)])
    for component in pinned:
        mine = faces[face_component == component]
        share = np.bincount(mine.ravel(), minlength=len(rest_vertices)) / mine.size
        vertices = np.unique(mine)
        held = (laplacian + scipy.sparse.diags(weight))[vertices][:, vertices].tocsc()
        moved = scipy.sparse.linalg.spsolve(held, share[vertices])
        response[vertices] = moved / (share[vertices] @ moved)
    return response


def barycentric_coordinates(points: torch.Tensor, triangles: torch.Tensor) -> torch.Tensor:
    """Barycentric coordinates of points on triangles; [P,3], [P,3,3] (corner, axis) -> [P,3], summing to one.

    By areas, u_k = n . ((V_k+1 - p) x (V_k+2 - p)) / n . n, which needs no solve.
    """
    a, b, c = triangles.unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    area = (normal * normal).sum(dim=-1).clamp(min=torch.finfo(points.dtype).tiny)
    u = (torch.linalg.cross(b - points, c - points) * normal).sum(dim=-1) / area
    v = (torch.linalg.cross(c - points, a - points) * normal).sum(dim=-1) / area
    return torch.stack([u, v, 1.0 - u - v], dim=-1)


def _surface_frames(triangles: torch.Tensor) -> torch.Tensor:
    """Orthonormal frames [tangent, bitangent, normal] as columns; [P,3,3] (corner, axis) -> [P,3,3]."""
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    tangent = torch.nn.functional.normalize(edge1, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(edge1, edge2), dim=-1)
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=-1)
