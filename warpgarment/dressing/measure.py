"""What is measured of a dressed garment: depth in the body, crossings, stretch, and what goes through its openings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import igl
import numpy as np
import torch

from warpgarment.geometry.over import sides_of
from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.crossings import Crossings, crossings
from warpgarment.kernels.cloth.pairs import FacePairs, Outfits
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import SurfaceDepth, surface_depth

from .limbs import Limb, Limbs
from .openings import Roles
from .report import PairReport


def crossing_pairs(points: np.ndarray, faces: np.ndarray, body: np.ndarray, body_faces: np.ndarray) -> int:
    """Number of pairs of a face of the garment and one of the body that cross, or were too many to look at.

    Args:
        points: Positions of the garment [m], [V,3].
        faces: Vertex indices, [F,3].
        body: Positions of the body [m], [U,3].
        body_faces: Vertex indices, [G,3].
    """
    both = np.concatenate([points, body])
    of_face = np.repeat([0, 1], [len(faces), len(body_faces)])
    found = _crossings(both, np.concatenate([faces, body_faces + len(points)]), of_face, itself=False)
    return int(found.layers[0]) + int(found.unseen[0])


def pairs_of(layers: Sequence[tuple[str, np.ndarray, np.ndarray]], body: BodyMeshes) -> tuple[PairReport, ...]:
    """How each pair of garments lies on each other.

    Args:
        layers: Name, positions [m], [V,3], and vertex indices, [F,3], of each garment, innermost first.
        body: The body.
    """
    found = []
    for (inner, under, under_faces), (outer, over, over_faces) in itertools.combinations(layers, 2):
        sheet = BodyMeshes(torch.from_numpy(under.astype(np.float32)), torch.from_numpy(under_faces))
        none = torch.zeros(len(over), dtype=torch.int32)
        sides = sides_of(torch.from_numpy(over.astype(np.float32)), none, sheet, body, none)
        crossing = crossing_pairs(over, over_faces, under, under_faces)
        found.append(PairReport(inner, outer, crossing, int(sides.above.sum()), int(sides.beneath.sum()), len(over)))
    return tuple(found)


def own_crossings(points: np.ndarray, faces: np.ndarray) -> int:
    """Number of pairs of faces of the garment that cross, or were too many to look at."""
    found = _crossings(points, faces, np.zeros(len(faces), int), itself=True)
    return int(found.itself[0]) + int(found.unseen[0])


def _crossings(points: np.ndarray, faces: np.ndarray, garment: np.ndarray, itself: bool) -> Crossings:
    def integers(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.int32))

    count = int(garment.max()) + 1
    outfits = Outfits(integers(faces), integers(garment), integers(0 * garment), integers(np.arange(count)), itself)
    at = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    pairs = FacePairs(outfits, at, margin=1e-5)
    pairs.find(at, at, torch.ones(count, dtype=torch.bool))
    contacts = Contacts(pairs, len(points), thickness=1e-5, rounds=1)
    return crossings(contacts.model, len(faces), torch.zeros((0, 0, 3)), at, count)


def depth_of(points: torch.Tensor, edges: np.ndarray, faces: np.ndarray, bodies: BodyMeshes) -> SurfaceDepth:
    """Depth of vertices, edges and faces in the body [m], see `SurfaceDepth`."""
    owner = torch.zeros(len(points), dtype=torch.int32)
    lines, triangles = (torch.from_numpy(np.ascontiguousarray(a, np.int32)) for a in (edges, faces))
    return surface_depth(points.float().contiguous(), bodies, owner, lines, triangles, owner, 1)


def stretch_of(points: np.ndarray, rest: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How much longer edges are than at rest, as a share of that, [E]."""
    now, before = (np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (points, rest))
    return now / before - 1.0


def unworn(points: np.ndarray, faces: np.ndarray, roles: Roles, limbs: Limbs) -> list[str]:
    """Names of openings through which no part of the body goes that should.

    The centre line of the part, from the middle of the trunk outwards and on, has to go through a surface that the
    opening bounds, more often one way than the other. An arm or a leg may end inside the garment, nearer to that
    opening than to any other.
    """
    trunk = _trunk(limbs)
    lines = {"neck": np.concatenate([trunk[::-1], limbs.head.line[::-1], _beyond(limbs.head.line)])}
    lines["neck"][-1] = limbs.head.line[0] + [0.0, limbs.height, 0.0]
    for name, pair in (("cuff", limbs.arms), ("leg", limbs.legs)):
        for k, limb in enumerate(pair):
            lines[f"{name} {k}"] = np.concatenate([trunk[len(trunk) // 2 :][:1], limb.line[::-1], _beyond(limb.line)])
    down = np.concatenate([trunk, trunk[-1:] - [0.0, 2.0 * limbs.height, 0.0]])
    missed = []
    for name, opening in roles.named.items():
        loop = opening.points(points)
        kind = name.split()[0]
        if kind in ("hem", "waist", "top"):
            wanted = [down, np.concatenate([trunk, trunk[-1:] + [0.0, 2.0 * limbs.height, 0.0]])]
        elif kind == "neck":
            wanted = [lines["neck"]]
        else:
            wanted = [line for key, line in lines.items() if key.startswith(kind)]
        if roles.kind == "jacket" and kind == "neck":
            continue
        worn = not wanted or any(_through(loop, line) for line in wanted)
        if not worn and kind in ("cuff", "leg"):
            worn = any(_ends_near(points, faces, roles, name, limb) for limb in (limbs.arms or limbs.legs))
        if not worn:
            missed.append(name)
    return missed


def _ends_near(points: np.ndarray, faces: np.ndarray, roles: Roles, name: str, limb: Limb) -> bool:
    """Whether a limb ends inside the garment, nearer to an opening than to any other."""
    tip = limb.line[: max(len(limb.line) // 6, 1)].mean(axis=0)
    away = {key: float(np.linalg.norm(one.points(points).mean(0) - tip)) for key, one in roles.named.items()}
    inside = float(igl.winding_number(points.astype(np.float64), faces.astype(np.int64), tip[None])[0])
    return min(away, key=lambda key: away[key]) == name and abs(inside) > 0.5


def _trunk(limbs: Limbs) -> np.ndarray:
    """Points from the middle of the chest down to the crotch and between the feet [m]."""
    neck = limbs.head.joint
    hips = np.mean([leg.joint for leg in limbs.legs], axis=0) if limbs.legs else neck - [0.0, 0.36 * limbs.height, 0.0]
    return np.stack([neck + share * (hips - neck) for share in np.linspace(0.15, 1.0, 8)])


def _beyond(line: np.ndarray) -> np.ndarray:
    """A point far beyond the tip of a limb, [1,3]."""
    way = line[0] - line[min(4, len(line) - 1)]
    return line[:1] + 0.6 * way / max(float(np.linalg.norm(way)), 1e-9)


def _through(loop: np.ndarray, line: np.ndarray) -> bool:
    """Whether a line goes through the cone over a loop from its centre, more often one way than the other."""
    centre = loop.mean(0)
    a, b = loop - centre, np.roll(loop, -1, 0) - centre
    total = 0.0
    for start, end in itertools.pairwise(line):
        way, offset = end - start, start - centre
        across = np.cross(np.broadcast_to(way, b.shape), b)
        size = (a * across).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (offset * across).sum(1) / size
            other = np.cross(np.broadcast_to(offset, a.shape), a)
            v = (way * other).sum(1) / size
            t = (b * other).sum(1) / size
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t < 1)
        total += float(np.sign(size[hit]).sum())
    return abs(total) > 0.5
