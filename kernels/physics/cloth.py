"""The constant part of the physics of a packed batch: masses, rest shapes and stiffness, and who gathers from whom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch

SHARE = 0.5
"""Share of the stiffness at rest in the constant matrix, with which fewest iterations are needed."""


class Sheet(NamedTuple):
    """One cloth, as the energies see it."""

    density: float
    """Mass per area [kg/m^2]."""
    stiffness: np.ndarray
    """Stress [N/m] over Green strain (E_11, E_22, 2 E_12) in the axes of the material, float64 [3,3], symmetric."""
    bend: float
    """Moment of a bent edge per angle and per length of the edge [N]."""
    damping: float = 0.0
    """Damping of the membrane, as a share of its stiffness [s]."""
    bend_damping: float = 0.0
    """Damping of bending: moment per rate of the angle and per length of the edge [N s]."""

    @classmethod
    def isotropic(
        cls, density: float, stretch: float, shear: float, bend: float, damping: float = 0.0, bend_damping: float = 0.0
    ) -> Sheet:
        """A sheet with the Lamé parameters λ = `stretch` and μ = `shear` [N/m]."""
        both = stretch + 2.0 * shear
        stiffness = np.array([[both, stretch, 0.0], [stretch, both, 0.0], [0.0, 0.0, shear]])
        return cls(density, stiffness, bend, damping, bend_damping)


class PhysicsCloth(NamedTuple):
    """The rest state of a packed batch of cloths, on one device. A group is what is solved together.

    Inner edges that more than two faces share are hinges between consecutive faces only.
    """

    faces: torch.Tensor
    """int32 [F,3]."""
    inverse_rest: torch.Tensor
    """D⁻¹ of membrane.py [1/m], float64 [F,2,2]."""
    stiffness: torch.Tensor
    """Rest area times stiffness [N m], float64 [F,3,3]."""
    damping: torch.Tensor
    """Damping of the membrane [s], float64 [F]."""
    hinges: torch.Tensor
    """int32 [H,4]: ends of an inner edge, then the corners opposite to it in its two faces."""
    rest_angle: torch.Tensor
    """θ⁰ of bending.py, float64 [H]."""
    bend: torch.Tensor
    """Stiffness [N] times rest length of the edge [m], float64 [H]."""
    bend_damping: torch.Tensor
    """Damping of bending times rest length of the edge [N m s], float64 [H]."""
    mass: torch.Tensor
    """Mass of each vertex [kg]: a third of that of its faces; float64 [V]."""
    area: torch.Tensor
    """A third of the rest area of the faces at each vertex [m^2], float64 [V]."""
    corner_start: torch.Tensor
    corners: torch.Tensor
    """Rows of corner gradients (3 F of faces, then 4 H of hinges) that each vertex sums: int32 [V+1] and [3F+4H]."""
    vertex_start: torch.Tensor
    face_start: torch.Tensor
    hinge_start: torch.Tensor
    """First vertex, face and hinge of each group, int32 [B+1]."""
    matrix: scipy.sparse.csr_matrix
    """Stiffness at rest of one coordinate [N/m], float64 [V,V], on the host: see `_rest_stiffness`."""

    @classmethod
    def build(
        cls,
        rest_vertices: np.ndarray,
        faces: np.ndarray,
        vertex_start: np.ndarray,
        sheets: Sequence[Sheet],
        sheet_of_face: np.ndarray,
        device: torch.device | str = "cpu",
        *,
        axes: np.ndarray | None = None,
    ) -> PhysicsCloth:
        """Takes the rest state from meshes.

        Args:
            rest_vertices: Rest positions [m], [V,3].
            faces: Packed vertex indices, [F,3]; those of a group lie together, in the order of the groups.
            vertex_start: First vertex of each group, [B+1].
            sheets: Cloths of the batch.
            sheet_of_face: Cloth of each face, [F].
            device: Device of the tensors.
            axes: Direction of the first axis of the material at each face, [F,3]; its part in the plane of the face is
                used. None, or no such part, takes the first edge. Isotropic sheets have no direction.

        Raises:
            ValueError: A rest face has no area, or the faces are not in the order of the groups.
        """
        points, faces = np.asarray(rest_vertices, np.float64), np.asarray(faces, np.int64).reshape(-1, 3)
        vertex_start = np.asarray(vertex_start, np.int64)
        group = np.searchsorted(vertex_start, faces, side="right") - 1
        if (group != group[:, :1]).any() or (np.diff(group[:, 0]) < 0).any():
            raise ValueError("faces must lie in one group each, and in the order of the groups")
        inverse, area = _rest_triangles(points, faces, axes)
        stiffness = np.stack([sheet.stiffness for sheet in sheets])[sheet_of_face] * area[:, None, None]
        density, damping, bend, bend_damping = (
            np.array([getattr(sheet, name) for sheet in sheets], np.float64)[sheet_of_face]
            for name in ("density", "damping", "bend", "bend_damping")
        )
        share = np.repeat(area / 3.0, 3)
        mass = np.bincount(faces.ravel(), share * np.repeat(density, 3), minlength=len(points))
        third = np.bincount(faces.ravel(), share, minlength=len(points))
        hinges, of_face = inner_edges(faces)
        hinge_group = group[of_face[:, 0], 0]
        order = np.argsort(hinge_group, kind="stable")
        hinges, of_face, hinge_group = hinges[order], of_face[order], hinge_group[order]
        length = np.linalg.norm(points[hinges[:, 1]] - points[hinges[:, 0]], axis=1)
        bend, bend_damping = (value[of_face].mean(axis=1) * length for value in (bend, bend_damping))
        used = np.concatenate([faces.ravel(), hinges.ravel()])
        corners = np.argsort(used, kind="stable")
        corner_start = np.searchsorted(used[corners], np.arange(len(points) + 1))
        groups = np.arange(len(vertex_start))
        host = {
            "faces": faces.astype(np.int32),
            "inverse_rest": inverse,
            "stiffness": stiffness,
            "damping": damping,
            "hinges": hinges.astype(np.int32),
            "rest_angle": angles(points, hinges),
            "bend": bend,
            "bend_damping": bend_damping,
            "mass": mass,
            "area": third,
            "corner_start": corner_start.astype(np.int32),
            "corners": corners.astype(np.int32),
            "vertex_start": vertex_start.astype(np.int32),
            "face_start": np.searchsorted(group[:, 0], groups).astype(np.int32),
            "hinge_start": np.searchsorted(hinge_group, groups).astype(np.int32),
        }
        tensors = {name: torch.from_numpy(np.ascontiguousarray(array)).to(device) for name, array in host.items()}
        return cls(**tensors, matrix=_rest_stiffness(points, faces, inverse, stiffness, hinges, bend))


def inner_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of two faces: [H,4] of its ends and the corners opposite to it, and [H,2] of its faces.

    The first face runs along the edge from its first end to the second, so that angles have the sign of the mesh's
    orientation; where two faces run along it in the same direction, that of the second is taken as it is.
    """
    start, end, opposite = faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((face, high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    first, second = order[:-1][same], order[1:][same]
    return np.stack([start[first], end[first], opposite[first], opposite[second]], 1), np.stack(
        [face[first], face[second]], 1
    )


def angles(points: np.ndarray, hinges: np.ndarray) -> np.ndarray:
    """Dihedral angle of each hinge, [H]; see bending.py."""
    x0, x1, x2, x3 = (points[hinges[:, k]] for k in range(4))
    edge = x1 - x0
    a, b = np.cross(edge, x2 - x0), np.cross(x3 - x0, edge)
    along = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-30)
    return np.arctan2((np.cross(a, b) * along).sum(1), (a * b).sum(1))


def _rest_triangles(points: np.ndarray, faces: np.ndarray, axes: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """D⁻¹ [F,2,2] and areas [F]."""
    a, b = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    normal = np.cross(a, b)
    double = np.linalg.norm(normal, axis=1)
    if not (double > 0).all():
        bad = np.flatnonzero(~(double > 0))
        raise ValueError(f"{len(bad)} of {len(faces)} rest faces have no area (first: face {bad[0]})")
    normal /= double[:, None]
    first = a.copy()
    if axes is not None:
        chosen = np.asarray(axes, np.float64)
        chosen = chosen - (chosen * normal).sum(1, keepdims=True) * normal
        length = np.linalg.norm(chosen, axis=1)
        first = np.where((length > 1e-9)[:, None], chosen, first)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    frame = np.stack([first, second], 1)
    rest = np.einsum("fai,fib->fab", frame, np.stack([a, b], 2))
    return np.linalg.inv(rest), 0.5 * double


def _rest_stiffness(
    points: np.ndarray,
    faces: np.ndarray,
    inverse: np.ndarray,
    stiffness: np.ndarray,
    hinges: np.ndarray,
    bend: np.ndarray,
) -> scipy.sparse.csr_matrix:
    """A constant matrix that bounds the stiffness of cloth that is not strained, for one coordinate.

    The membrane contributes Gᵀ diag(A C_11, A C_22) G, with G the gradient along the axes of the material: its own
    Hessian in the plane is that for each axis, without the coupling of coordinates, and zero across the plane. A hinge
    contributes k l w wᵀ, with w the derivative of its angle by the distance of its vertices from the plane of the flat
    edge.
    """
    count, rows = len(points), np.arange(2 * len(faces))
    gradient = np.zeros((len(faces), 3, 2))
    gradient[:, 1:] = inverse
    gradient[:, 0] = -inverse.sum(axis=1)
    shape = (len(rows), count)
    entries = (gradient.transpose(0, 2, 1).ravel(), (np.repeat(rows, 3), np.repeat(faces[:, None], 2, axis=1).ravel()))
    along = scipy.sparse.csr_matrix(entries, shape=shape)
    matrix = along.T @ scipy.sparse.diags(stiffness[:, [0, 1], [0, 1]].ravel()) @ along
    if len(hinges):
        weights = flat_weights(points, hinges)
        entries = (weights.ravel(), (np.repeat(np.arange(len(hinges)), 4), hinges.ravel()))
        across = scipy.sparse.csr_matrix(entries, shape=(len(hinges), count))
        matrix = matrix + across.T @ scipy.sparse.diags(bend) @ across
    return (SHARE * matrix).tocsr()


def flat_weights(points: np.ndarray, hinges: np.ndarray) -> np.ndarray:
    """∂θ by the heights of the four vertices over the plane of the flattened edge [1/m], [H,4]; each row sums to 0."""
    x0, x1, x2, x3 = (points[hinges[:, k]] for k in range(4))
    edge = x1 - x0
    length = np.linalg.norm(edge, axis=1)
    along = edge / length[:, None]
    a, b = (np.linalg.norm(np.cross(edge, x - x0), axis=1) for x in (x2, x3))
    low = -(((x2 - x1) * along).sum(1) / a + ((x3 - x1) * along).sum(1) / b)
    high = ((x2 - x0) * along).sum(1) / a + ((x3 - x0) * along).sum(1) / b
    return np.stack([low, high, -length / a, -length / b], 1)
