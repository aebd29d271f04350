"""Garments that lie on a body while that grows and moves slowly: implicit steps without inertia of the past.

Each step minimises the energies of `warpgarment.kernels.physics` from where the last one ended, with velocities of
zero, so that cloth creeps and never swings. Cloth keeps a distance from the body and from itself, and no step lets
faces of the garment cross that did not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from warpgarment.kernels.cloth.pairs import PARTNERS, Outfits
from warpgarment.kernels.physics import ImplicitSolver, PhysicsCloth, Sheet
from warpgarment.kernels.physics.meeting import Meeting
from warpgarment.kernels.physics.planes import planes_of, pressed, touch
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.objects.material import Material

STEP = 1.0 / 30.0
"""Duration of a step [s]: how far gravity pulls in one."""
ITERATIONS = 12
CONTACT = 4e5
"""Stiffness of contact with the body, per area [N/m^3]."""
GAP = 0.02
"""Distance beyond the one to keep within which contact is detected [m]."""
MEETS = 0.003
"""Most that cloth keeps from cloth [m]; at most a quarter of the edges."""
SELF = 20.0
"""Stiffness of a pair of faces [N/m]."""
FRICTION = 0.3
DOWN = np.array([0.0, -9.81, 0.0])


class Layer(NamedTuple):
    """One of the garments of a `Drape`."""

    rest: np.ndarray
    """Rest positions [m], [V,3]."""
    faces: np.ndarray
    """Vertex indices, [F,3]."""
    start: np.ndarray
    """Positions at the start [m], [V,3]."""
    keep: float
    """Distance to keep from the body [m]."""
    material: Material | None
    """Cloth; None for a garment that is held, and moved as it is told."""


class Drape:
    """Garments on a body, which do not cross each other and themselves.

    Args:
        layers: The garments, innermost first; their vertices and faces are packed in that order.
        body: Positions of the body at the start [m], [U,3].
        body_faces: Vertex indices of the body, [G,3].
        partners: Room for faces that can meet one face, see `FacePairs`.

    Attributes:
        points: Current positions [m], float64 [V,3].
        keep: Distance that each vertex keeps from the body [m], float32 [V].
        offsets: First vertex of each garment, and the number of all, [B+1].
    """

    def __init__(
        self, layers: Sequence[Layer], body: np.ndarray, body_faces: np.ndarray, *, partners: int = PARTNERS
    ) -> None:
        self.offsets = np.cumsum([0, *(len(layer.rest) for layer in layers)])
        count = int(self.offsets[-1])
        rest = np.concatenate([layer.rest for layer in layers])
        faces = np.concatenate([layer.faces + first for layer, first in zip(layers, self.offsets[:-1], strict=True)])
        of_face = np.repeat(np.arange(len(layers)), [len(layer.faces) for layer in layers])
        sheets = [_sheet(layer.material) for layer in layers]
        cloth = PhysicsCloth.build(rest, faces, np.array([0, count]), sheets, of_face)
        self.points = torch.from_numpy(np.concatenate([np.array(layer.start, np.float64) for layer in layers]))
        edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2), 1)
        length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        apart = float(min(MEETS, 0.25 * np.percentile(length, 20)))
        garment = torch.from_numpy(of_face.astype(np.int32))
        rank = torch.arange(len(layers), dtype=torch.int32)
        outfits = Outfits(cloth.faces, garment, torch.zeros_like(garment), rank)
        one = torch.zeros(count, dtype=torch.int32)
        self._meeting = Meeting(outfits, self.points, apart, one, 1, margin=0.004, soon=0.5 * apart, partners=partners)
        self._cloth, self._apart = cloth, apart
        self.body = BodyMeshes(_float(body), torch.from_numpy(np.ascontiguousarray(body_faces, np.int32)))
        self.keep = torch.from_numpy(
            np.repeat(np.array([layer.keep for layer in layers], np.float32), np.diff(self.offsets))
        )
        self._held = np.repeat([layer.material is None for layer in layers], np.diff(self.offsets))
        self._solver = self._made(self._held if self._held.any() else None)

    def _made(self, held: np.ndarray | None) -> ImplicitSolver:
        return ImplicitSolver(
            self._cloth,
            inertia=1.0 / STEP**2,
            iterations=ITERATIONS,
            held=held,
            contact=CONTACT,
            slip=1e-3,
            memory=12,
            keep_pairs=True,
            pairs=self._meeting.contacts,
            pair_distance=self._apart,
            pair_stiffness=SELF,
        )

    @property
    def held(self) -> np.ndarray:
        """Positions of the vertices that are held [m], float64 [P,3]."""
        return self.points.numpy()[self._held]

    def hold(self, pins: np.ndarray) -> None:
        """Keeps vertices [P] where they are from now on."""
        self._held[pins] = True
        self._solver = self._made(self._held)

    def step(
        self, body: np.ndarray, gravity: float = 1.0, friction: float = FRICTION, moved: np.ndarray | None = None
    ) -> None:
        """One step in which the body moves to where it is given [m], [U,3].

        Args:
            body: Positions of the body at the end of the step [m], [U,3].
            gravity: Share of gravity.
            friction: Coulomb coefficient.
            moved: Where vertices that are held go [m], in their order; as far as nothing crosses. None: they stay.
        """
        solver, before, points = self._solver, self.body.vertices.clone(), self.points
        guess = points
        if moved is not None:
            guess = points.clone()
            guess[torch.from_numpy(self._held)] = torch.from_numpy(moved)
        self.body.update(_float(body))
        planes = planes_of(points, self.body, before, self.keep, self.keep + GAP)
        solver.friction.copy_(friction * pressed(solver, points))
        touch(solver, planes)
        solver.anchor.copy_(points + planes.way)
        solver.target.copy_(points + torch.from_numpy(gravity * STEP**2 * DOWN))
        solver.positions.copy_(guess)
        solver.remember()
        self._meeting.find(points, guess)
        self.points = self._meeting.safe(solver.solve()).clone()


def _float(points: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(points, np.float32))


def _sheet(material: Material | None) -> Sheet:
    """A cloth; one without stiffness for a garment that is held, which may be folded into a line."""
    if material is None:
        return Sheet.isotropic(0.1, 0.0, 0.0, 0.0)
    return Sheet.isotropic(material.density, material.stretch, material.shear, material.bend)
