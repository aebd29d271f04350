"""Patches by texture coordinates, as LayersNet was published: faces with a centroid in the same cell of the same part.

A part is what the texture coordinates join, such as a pattern panel. The publication's cells have a side of 0.04 of its
data's textures; here the side is a length on the cloth, and the texture's scale is found from the areas of the faces.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from warpgarment.io.surface.record import Coordinates
from warpgarment.objects.garment import Garment


def texture_cells(garment: Garment, side: float) -> np.ndarray | None:
    """The cell of each face.

    Args:
        garment: The garment; of its sets of texture coordinates the first one counts.
        side: Side of a cell on the cloth [m].

    Returns:
        Numbers of cells, int64 [F]; None if some face has no texture coordinates, or they have no area.
    """
    corners = _corners(garment)
    if corners is None:
        return None
    where = corners.values[corners.corners].astype(np.float64)  # [F,3,2]
    (a, b), points = (where[:, 1:] - where[:, :1]).transpose(1, 0, 2), garment.vertices[garment.faces].astype(float)
    flat = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    if not flat > 0.0:
        return None
    scale = np.sqrt(0.5 * np.linalg.norm(cross, axis=1).sum() / flat)  # metres of cloth for one unit of texture
    cell = np.floor(where.mean(axis=1) * scale / side).astype(np.int64)
    face = np.repeat(np.arange(len(where)), 3)
    joins = sp.coo_matrix((np.ones(len(face)), (face, corners.corners.ravel())))
    _, part = connected_components(sp.bmat([[None, joins], [joins.T, None]]), directed=False)
    _, number = np.unique(np.column_stack([part[: len(where)], cell]), axis=0, return_inverse=True)
    return number.reshape(-1).astype(np.int64)


def _corners(garment: Garment) -> Coordinates | None:
    """The first set of texture coordinates with `corners` of the garment's faces, [F,3]; None if there is none."""
    surface = garment.surface
    if surface is None or not surface.coordinates:
        return None
    coordinates, owner = surface.coordinates[0], surface.polygon_of_triangle
    if len(owner) != len(garment.faces):
        return None
    count = len(garment.vertices)
    polygon = np.repeat(np.arange(len(surface.counts)), surface.counts)
    key = polygon.astype(np.int64) * count + surface.corners
    order = np.argsort(key, kind="stable")
    wanted = np.asarray(owner, np.int64)[:, None] * count + garment.faces
    place = np.searchsorted(key[order], wanted).clip(max=len(key) - 1)
    corner = order[place]
    found = coordinates.corners[corner]
    if (key[corner] != wanted).any() or (found < 0).any():
        return None
    return coordinates._replace(corners=found)
