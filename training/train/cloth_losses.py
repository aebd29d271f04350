r"""Terms of the loss of unrolled training that see the cloth as a whole: its looks and its physics.

Folds come and go by chance, so the mean over what could be, which the distance from a recording asks for, has none.
These terms ask how much the cloth is folded and strained, and not where. For predicted positions x, recorded ones x*,
and the cloth's energies M (membrane) and B (bending) of `warpgarment.kernels.physics`, of each garment:

    normal    mean over faces of |n - n*|^2
    bending   (ln (B + b) - ln (B* + b))^2,    b the energy of 0.01 rad at every edge
    membrane  (ln (M + m) - ln (M* + m))^2,    m the energy of 0.1 % of strain in every face

and without a recording, from the two states before x:

    physics   [ 1/2 h^-2 sum m |x - (2 x_k - x_{k-1})|^2 - sum m g (x - x_k) + M + B ] / (g sum m)

in metres: what an implicit Euler step of the cloth minimises, of the duration h of a frame (Gast et al., "Optimization
integrator for large time steps", 2015; as a loss: Santesteban, Otaduy and Casas, "SNUG", 2022). The states before are
constants in it. It knows no air, and no contact: the positions are those after the collision passes, and where these
move a vertex, the gradient is theirs.

In a network with the physics stage, M is the energy before the stage, which folds what the network squeezes: the strain
that is left after it says little of how much that was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from warpgarment.kernels.deformation.gradients import face_normals
from warpgarment.kernels.physics import PhysicsCloth
from warpgarment.kernels.physics.energies import ClothEnergies, cloth_energies
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.stages.relax import sheets_of

GRAVITY = 9.81  # m/s^2, along -Y
BENT, STRAINED = 0.01, 1e-3  # rad; without unit


@dataclass(frozen=True)
class ClothLossConfig:
    """Weights of these terms; 0, the default, leaves one out.

    Attributes:
        normal: Weight of the difference of unit normals.
        bending: Weight of the difference of the logarithms of bending energies.
        membrane: Weight of that of membrane energies.
        physics: Weight of the potential of a step of the cloth [1/m], which needs no recording.
    """

    normal: float = 0.0
    bending: float = 0.0
    membrane: float = 0.0
    physics: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"cloth.{name} must be at least 0, got {value}")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms with a weight."""
        return tuple(name for name, value in vars(self).items() if value)


class ClothState(NamedTuple):
    """What the terms of a step are of: positions [m], [V,3] each."""

    found: torch.Tensor  # predicted
    recorded: torch.Tensor
    now: torch.Tensor  # the predicted state before
    before: torch.Tensor  # the one before that
    solved: torch.Tensor | None = None  # predicted, before the stage of `sim/stages/relax.py`; None without one


class ClothLosses:
    """The terms, for one batch.

    Args:
        config: Weights.
        packed: The garments.
        materials: Fields of the material of each, float32 [B,M]; NaN for the default material.
        fps: Frames per second.
        counted: Garments with a recording, bool [B].
        cloth: Rest state of the garments with these materials, of any mass, if there is one; None: it is made here.
    """

    def __init__(
        self,
        config: ClothLossConfig,
        packed: PackedGarments,
        materials: torch.Tensor,
        fps: float,
        counted: torch.Tensor,
        cloth: PhysicsCloth | None = None,
    ) -> None:
        self.config, self._packed, self._fps, self._counted = config, packed, fps, counted.double()
        sheets, self._of_vertex = sheets_of(materials, packed.count), packed.garment_of_vertex.long()
        if cloth is None:
            rest, faces = packed.rest_vertices.cpu().numpy(), packed.faces.cpu().numpy()
            starts, owner = np.array(packed.vertex_offsets), packed.garment_of_face.cpu().numpy()
            cloth = PhysicsCloth.build(rest, faces, starts, sheets, owner, packed.faces.device)
        density = cloth.area.new_tensor([sheet.density for sheet in sheets])
        self._cloth = cloth = cloth._replace(mass=cloth.area * density[self._of_vertex])
        group = torch.bucketize(cloth.hinges[:, 0].contiguous(), cloth.vertex_start[1:], right=True)
        self._bent = cloth.bend.new_zeros(packed.count).index_add_(0, group, 0.5 * BENT**2 * cloth.bend)
        stiff = 0.5 * STRAINED**2 * cloth.stiffness[:, 0, 0]
        self._strained = stiff.new_zeros(packed.count).index_add_(0, packed.garment_of_face.long(), stiff)
        self._mass = cloth.mass.new_zeros(packed.count).index_add_(0, self._of_vertex, cloth.mass)

    def __call__(self, state: ClothState) -> torch.Tensor:
        """The terms with a weight, in the order of `ClothLossConfig.terms`, as means over the garments; float32 [K]."""
        predicted = cloth_energies(state.found, self._cloth)
        with torch.no_grad():
            wanted = cloth_energies(state.recorded, self._cloth)
        every = {
            "normal": lambda: self._mean(self._normals(state)),
            "bending": lambda: self._mean(_ratio(predicted.bending, wanted.bending, self._bent)),
            "membrane": lambda: self._mean(_ratio(self._membrane(state, predicted), wanted.membrane, self._strained)),
            "physics": lambda: (self._potential(state, predicted.membrane + predicted.bending)).mean(),
        }
        return torch.stack([every[name]() for name in self.config.terms]).float()

    def _membrane(self, state: ClothState, predicted: ClothEnergies) -> torch.Tensor:
        return predicted.membrane if state.solved is None else cloth_energies(state.solved, self._cloth).membrane

    def _mean(self, values: torch.Tensor) -> torch.Tensor:
        """Mean of values of garments [B], of which those without a recording are zero."""
        return (values * self._counted).mean()

    def _normals(self, state: ClothState) -> torch.Tensor:
        faces, owner = self._packed.faces, self._packed.garment_of_face.long()
        off = face_normals(state.found, faces) - face_normals(state.recorded, faces)
        count = torch.bincount(owner, minlength=self._packed.count)
        return off.new_zeros(len(count)).index_add(0, owner, off.square().sum(1)).double() / count

    def _potential(self, state: ClothState, energy: torch.Tensor) -> torch.Tensor:
        now, before = state.now.detach().double(), state.before.detach().double()
        moved = state.found.double() - now
        away = moved - (now - before)
        each = self._cloth.mass * (0.5 * self._fps**2 * away.square().sum(1) + GRAVITY * moved[:, 1])
        return (energy.new_zeros(len(energy)).index_add(0, self._of_vertex, each) + energy) / (GRAVITY * self._mass)


def _ratio(found: torch.Tensor, wanted: torch.Tensor, least: torch.Tensor) -> torch.Tensor:
    return ((found + least).log() - (wanted + least).log()).square()
