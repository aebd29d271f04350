"""Step 4b of a frame: a few iterations of the cloth's own physics towards what the network predicts.

Networks lose folds: they squeeze cloth where it should bend. From the solved positions V⁰ the stage lowers

    ½ (2π / L)² Σ k a |V - V⁰|² + membrane + bending

by L-BFGS (`warpgarment.kernels.physics`). A wave of length l in a membrane of stiffness k has the energy of the first
term with l in place of L. So of waves longer than L the network decides and of shorter ones the physics, whatever the
cloth is made of: it keeps its place and gets its lengths back. Pins stay. The gradient is that of the identity:
networks can be trained with the stage, past it.

| symbol | code | what |
| --- | --- | --- |
| V⁰ | `solved` | positions after the Poisson solve [m] |
| L | `length` | length of waves for which both terms are equal [m] |
| k | `Sheet.stiffness` | stiffness of the membrane along a thread [N/m] |
| a | | area of a vertex, a third of those of its faces [m²] |
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
import torch

from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.timing import Timings

if TYPE_CHECKING:
    from warpgarment.kernels.physics import PhysicsCloth, Sheet

MEMORY = 6
"""Pairs of the quasi-Newton method; more than there are iterations are of no use."""
PER_VERTEX, PER_FACE = 24 * (2 * MEMORY + 14), 800
"""Bytes of a batch for each vertex and face, besides the factor."""


class Relax:
    """Lowers the energy of cloth near predicted positions.

    Args:
        packed: The batch.
        iterations: Evaluations of energy and gradient in a frame; 0: the stage does nothing.
        length: Waves of the cloth longer than this are the network's, shorter ones the physics' [m].
        materials: Fields of the material of each garment, [B,M], NaN for the default material; None: all have that.
        timings: Times of the stages, to which this one adds its own as "physics".

    Attributes:
        on: Whether the stage does anything.
        cloth: The rest state of the batch, whose masses are areas times the mean stiffness of the membrane; None if
            the stage does nothing.
    """

    def __init__(
        self,
        packed: PackedGarments,
        iterations: int,
        length: float,
        materials: torch.Tensor | None,
        timings: Timings,
    ) -> None:
        self._packed, self._timings, self.on = packed, timings, iterations > 0
        self.cloth: PhysicsCloth | None = None
        if not self.on:
            return
        from warpgarment.kernels.physics import ImplicitSolver, PhysicsCloth  # most simulations do without

        rest, faces = packed.rest_vertices.cpu().numpy(), packed.faces.cpu().numpy()
        held = np.zeros(len(rest), bool)
        held[packed.pins.cpu().numpy()] = True
        owner = packed.garment_of_face.cpu().numpy()
        sheets = [
            sheet._replace(density=sheet.stiffness[:2, :2].trace() / 2.0)
            for sheet in sheets_of(materials, packed.count)
        ]
        cloth = PhysicsCloth.build(rest, faces, np.array(packed.vertex_offsets), sheets, owner, packed.faces.device)
        self.cloth = cloth
        self._solver = ImplicitSolver(
            cloth,
            inertia=(2.0 * np.pi / length) ** 2,
            iterations=iterations + 1,
            held=held,
            memory=min(MEMORY, iterations),
        )

    def __call__(self, solved: torch.Tensor, finite: torch.Tensor) -> torch.Tensor:
        """Relaxed positions [m], shape [V,3]; those of garments that are not finite are not changed.

        Args:
            solved: Positions V⁰ [m], float32 [V,3].
            finite: Which garments are simulated, bool [B].
        """
        if not self.on:
            return solved
        with self._timings("physics"), torch.no_grad():
            start = solved.detach().double()
            self._solver.target.copy_(start)
            self._solver.positions.copy_(start)
            relaxed = self._solver.solve().float()
            moving = finite[self._packed.garment_of_vertex.long()][:, None] & relaxed.isfinite()
            change = torch.where(moving, relaxed - solved, 0.0)
        return solved + change


def sheets_of(materials: torch.Tensor | None, count: int) -> list[Sheet]:
    """The cloth of each garment from the fields of `Material`, [B,M], or the default material."""
    from warpgarment.kernels.physics import Sheet

    default = Material()
    names = [field.name for field in fields(Material)]
    rows = [[np.nan] * len(names)] * count if materials is None else materials.cpu().tolist()
    sheets = []
    for row in rows:
        known = {name: value for name, value in zip(names, row, strict=True) if np.isfinite(value)}
        one = default if len(known) < len(names) else Material(**known)
        sheets.append(Sheet.isotropic(one.density, one.stretch, one.shear, one.bend))
    return sheets
