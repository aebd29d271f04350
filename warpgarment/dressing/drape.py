"""A garment that lies on a body while that grows and moves slowly: implicit steps without inertia of the past.

Each step minimises the energies of `warpgarment.kernels.physics` from where the last one ended, with velocities of
zero, so that cloth creeps and never swings. Cloth keeps a distance from the body and from itself, and no step lets
faces of the garment cross that did not.
"""

from __future__ import annotations

import numpy as np
import torch

from warpgarment.kernels.cloth.pairs import Outfits
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


class Drape:
    """A garment on a body.

    Args:
        rest: Rest positions [m], [V,3].
        faces: Vertex indices, [F,3].
        start: Positions at the start [m], [V,3].
        body: Positions of the body at the start [m], [U,3].
        body_faces: Vertex indices of the body, [G,3].
        keep: Distance to keep from the body [m].
        material: Cloth.

    Attributes:
        points: Current positions [m], float64 [V,3].
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        start: np.ndarray,
        body: np.ndarray,
        body_faces: np.ndarray,
        keep: float,
        material: Material,
    ) -> None:
        count = len(rest)
        sheet = Sheet.isotropic(material.density, material.stretch, material.shear, material.bend)
        cloth = PhysicsCloth.build(rest, faces, np.array([0, count]), [sheet], np.zeros(len(faces), int))
        self.points = torch.from_numpy(np.array(start, np.float64))
        edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2), 1)
        length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        apart = float(min(MEETS, 0.25 * np.percentile(length, 20)))
        one = torch.zeros(len(faces), dtype=torch.int32)
        outfits = Outfits(cloth.faces, one, one, torch.zeros(1, dtype=torch.int32))
        self._meeting = Meeting(
            outfits, self.points, apart, torch.zeros(count, dtype=torch.int32), 1, margin=0.004, soon=0.5 * apart
        )
        self._cloth, self._apart = cloth, apart
        self._solver = self._made(None)
        self.body = BodyMeshes(_float(body), torch.from_numpy(np.ascontiguousarray(body_faces, np.int32)))
        self.keep = torch.full((count,), keep, dtype=torch.float32)

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

    def hold(self, pins: np.ndarray) -> None:
        """Keeps vertices [P] where they are from now on."""
        held = np.zeros(len(self.points), bool)
        held[pins] = True
        self._solver = self._made(held)

    def step(self, body: np.ndarray, gravity: float = 1.0, friction: float = FRICTION) -> None:
        """One step in which the body moves to where it is given [m], [U,3].

        Args:
            body: Positions of the body at the end of the step [m], [U,3].
            gravity: Share of gravity.
            friction: Coulomb coefficient.
        """
        solver, before, points = self._solver, self.body.vertices.clone(), self.points
        self.body.update(_float(body))
        planes = planes_of(points, self.body, before, self.keep, self.keep + GAP)
        solver.friction.copy_(friction * pressed(solver, points))
        touch(solver, planes)
        solver.anchor.copy_(points + planes.way)
        solver.target.copy_(points + torch.from_numpy(gravity * STEP**2 * DOWN))
        solver.positions.copy_(points)
        solver.remember()
        self._meeting.find(points, points)
        self.points = self._meeting.safe(solver.solve()).clone()


def _float(points: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(points, np.float32))
