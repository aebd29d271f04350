"""Implicit steps of cloth: the minimum of inertia and energies, by L-BFGS on a constant matrix that is factored once.

One step of length h from x⁻ with velocity v⁻ minimises

    ½ c Σ m |x - y|² + W(x)
    Euler:  y = x⁻ + h v⁻ + h² a,                                          c = 1 / h²
    BDF2:   y = (4 x⁻ - x⁻⁻) / 3 + h (8 v⁻ - 2 v⁻⁻) / 9 + (4 h² / 9) a,    c = 9 / (4 h²)

(Hairer and Wanner, "Solving Ordinary Differential Equations II", III.1; BDF2 is of second order and damps fast motion
only.) W holds the energies of membrane.py, bending.py and vertices.py. The matrix c M + K, with K the stiffness at
rest, is factored once.

| symbol | code | what |
| --- | --- | --- |
| x, v | `positions`, `velocities` | positions [m] and velocities [m/s] |
| a | `acceleration` | of outer forces: gravity, air [m/s²] |
| h | `step` | length of a step [s] |
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy.sparse
import torch
import warp as wp

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.launch import as_warp, torch_stream
from warpgarment.kernels.linear import triangular
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System, block_dim
from warpgarment.kernels.operator import allocate

from .bending import angle_kernel, bending_kernel
from .cloth import PhysicsCloth
from .membrane import membrane_kernel, strain_kernel
from .pairs import pair_kernel
from .quasi_newton import Search, accept_kernel, begin_kernel, direct_kernel
from .vertices import vertex_kernel

Scheme = Literal["euler", "bdf2"]


class ImplicitSolver:
    """Minimises inertia and energies of a batch of cloths, each group on its own.

    Args:
        cloth: The batch.
        inertia: c, one over the square of a time [1/s²].
        iterations: Evaluations of energy and gradient in a solve.
        held: Vertices whose positions are given, bool [V]; None for none.
        contact: Stiffness of contact with planes, per area [N/m³].
        slip: Way [m] in a step below which friction is not yet full.
        memory: Pairs of the quasi-Newton method.
        tolerance: Root of the mean square of a step [m] below which a group is done; 0: never.
        damping_step: Length of the step by which damping is divided [s]; infinite for none.
        keep_pairs: Whether a solve starts with the pairs of moves and changes of the one before. In steps that follow
            each other this halves the iterations; the result then depends on the steps before.
        pairs: Pairs of faces that keep a distance, members being the faces of the batch in their order; None for none.
            Those found before a solve count in it.
        pair_distance: Distance that pairs keep [m].
        pair_stiffness: Stiffness of a pair [N/m].
        pair_friction: Coulomb coefficient of each face against others, float64 [F]; None: 0.

    Attributes:
        contact: Stiffness of contact of each vertex [N/m], float64 [V].
        target, normal, offset, distance, anchor, friction: Inputs of a solve, see vertices.py; written in place.
        positions: Where a solve starts, and after it the result [m], float64 [V,3].

    """

    def __init__(
        self,
        cloth: PhysicsCloth,
        *,
        inertia: float,
        iterations: int,
        held: np.ndarray | None = None,
        contact: float = 1e5,
        slip: float = 1e-4,
        memory: int = 8,
        tolerance: float = 0.0,
        damping_step: float = float("inf"),
        keep_pairs: bool = False,
        pairs: Contacts | None = None,
        pair_distance: float = 0.004,
        pair_stiffness: float = 20.0,
        pair_friction: torch.Tensor | None = None,
    ) -> None:
        device, count = cloth.mass.device, len(cloth.mass)
        if not (inertia > 0 and iterations > 0 and memory > 0):
            raise ValueError(f"inertia {inertia}, iterations {iterations} and memory {memory} must be positive")
        held = np.zeros(count, bool) if held is None else np.asarray(held, bool)
        self.cloth, self.iterations, self._device = cloth, int(iterations), device
        self._groups = len(cloth.vertex_start) - 1
        self._early = tolerance > 0.0 and device.type == "cpu"  # a GPU does all iterations: the host would wait for it
        matrix = cloth.matrix + scipy.sparse.diags(inertia * np.maximum(cloth.mass.cpu().numpy(), 1e-12))
        free = scipy.sparse.diags((~held).astype(np.float64))
        matrix = (free @ matrix @ free + scipy.sparse.diags(held * matrix.diagonal().max(initial=1e-12))).tocsr()
        group = np.repeat(np.arange(self._groups), np.diff(cloth.vertex_start.cpu().numpy()))
        self._system = System.build(matrix, group, self._groups, device)
        self._factor = Factor.build(matrix, self._system, explicit=device.type != "cpu")
        if self._factor.unfactored:
            raise ValueError(f"{self._factor.unfactored} of {self._groups} matrices could not be factored")
        self._group = torch.from_numpy(group.astype(np.int32)).to(device)

        def rows(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        def empty(*shape: int) -> torch.Tensor:
            return allocate(shape, torch.float64, device)

        faces, hinges, groups = len(cloth.faces), len(cloth.hinges), self._groups
        self.positions, self.target, self.anchor, self.normal, self.before = (rows(count, 3) for _ in range(5))
        self.offset, self.distance, self.friction = (rows(count) for _ in range(3))
        self.strain, self.angle = rows(faces, 3), rows(hinges)
        self._more = rows(count, 3)
        self._corner = empty(3 * faces + 4 * hinges, 3)
        self._energies = empty(faces), empty(hinges), empty(count)
        self._gradient, self._load, self._solved = (empty(count, 3) for _ in range(3))
        integers = {name: rows(groups, dtype=torch.int32) for name in ("pairs", "newest", "fresh", "done")}
        numbers = {name: rows(groups) for name in ("energy", "slope", "step")}
        numbers |= {name: rows(groups, memory) for name in ("curvature", "weight")}
        vectors = {name: rows(count, 3) for name in ("point", "gradient", "direction")}
        vectors |= {name: rows(memory, count, 3) for name in ("moves", "changes")}
        self.search = {**integers, **numbers, **vectors}
        self._search = Search()
        for name, tensor in self.search.items():
            kind = wp.vec3d if name in vectors else wp.int32 if name in integers else wp.float64
            setattr(self._search, name, as_warp(tensor, kind))
        self.contact = cloth.area * contact
        loads = self._load, self._solved
        self._solve = triangular.recorded(self._system, self._factor, self._group, *loads)
        self._damping = cloth.damping / damping_step, cloth.bend_damping / damping_step
        self._commands = self._recorded(
            as_warp(torch.from_numpy(held.astype(np.int32)).to(device), wp.int32),
            self.contact,
            inertia,
            slip,
            memory,
            tolerance,
            keep_pairs,
            (pairs, pair_distance, pair_stiffness, pair_friction),
        )

    def _recorded(
        self,
        held: wp.array,
        contact: torch.Tensor,
        inertia: float,
        slip: float,
        memory: int,
        tolerance: float,
        keep_pairs: bool,
        springs: tuple[Contacts | None, float, float, torch.Tensor | None],
    ) -> dict[str, Any]:
        """Launches of a solve, by name, with their arguments."""
        cloth, device = self.cloth, wp.device_from_torch(self._device)
        faces, hinges = len(cloth.faces), len(cloth.hinges)
        trial = as_warp(self.positions, wp.vec3d)
        integer = {name: as_warp(getattr(cloth, name), wp.int32) for name in ("corner_start", "corners")}
        starts = [as_warp(t, wp.int32) for t in (cloth.vertex_start, cloth.face_start, cloth.hinge_start)]
        triangles = [as_warp(cloth.faces, wp.vec3i), as_warp(cloth.inverse_rest, wp.mat22d)]
        hinge = as_warp(cloth.hinges, wp.vec4i)
        energies = [as_warp(t, wp.float64) for t in self._energies]
        corner, gradient = as_warp(self._corner, wp.vec3d), as_warp(self._gradient, wp.vec3d)
        of_hinges = as_warp(self._corner[3 * faces :], wp.vec3d)
        strain, angle = as_warp(self.strain, wp.vec3d), as_warp(self.angle, wp.float64)
        block = block_dim(self._device, len(cloth.mass), self._groups)

        # A recorded launch keeps no array alive.
        self._kept = [held, contact, trial, *integer.values(), *starts, *triangles, hinge, *energies, corner, gradient]
        self._kept += [strain, angle, of_hinges]

        def record(kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> Any:
            return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)

        def record_blocks(kernel: Any, inputs: list[Any], outputs: list[Any]) -> Any:
            arguments = {"inputs": inputs, "outputs": outputs, "block_dim": block, "device": device}
            return wp.launch_tiled(kernel, dim=[self._groups], record_cmd=True, **arguments)

        stiffness = [as_warp(cloth.stiffness, wp.mat33d), as_warp(self._damping[0], wp.float64)]
        bending = [as_warp(t, wp.float64) for t in (cloth.rest_angle, cloth.bend, self._damping[1])]
        planes = [
            as_warp(self.target, wp.vec3d),
            as_warp(self.normal, wp.vec3d),
            as_warp(self.offset, wp.float64),
            as_warp(self.distance, wp.float64),
            as_warp(self.anchor, wp.vec3d),
            as_warp(self.friction, wp.float64),
        ]
        model = [as_warp(cloth.mass, wp.float64), *integer.values(), as_warp(contact, wp.float64), held, inertia, slip]
        more = as_warp(self._more, wp.vec3d)
        load, solved = as_warp(self._load, wp.vec3d), as_warp(self._solved, wp.vec3d)
        self._kept += [*stiffness, *bending, *planes, *model, load, solved, more]
        commands = {
            "strain": record(strain_kernel, faces, [*triangles, trial], [strain]),
            "angle": record(angle_kernel, hinges, [hinge, trial], [angle]),
            "begin": record(begin_kernel, self._groups, [self._search, int(keep_pairs)], []),
            "membrane": record(membrane_kernel, faces, [*triangles, *stiffness, trial, strain], [energies[0], corner]),
            "bending": record(bending_kernel, hinges, [hinge, *bending, trial, angle], [energies[1], of_hinges]),
            "vertices": record(
                vertex_kernel, len(cloth.mass), [*model, trial, *planes, corner, more], [energies[2], gradient]
            ),
            "accept": record_blocks(accept_kernel, [*starts, memory, self._search, *energies, trial, gradient], [load]),
            "direct": record_blocks(
                direct_kernel, [starts[0], memory, float(tolerance), self._search, solved], [trial]
            ),
        }
        if not hinges:
            del commands["angle"], commands["bending"]
        pairs, distance, stiffness_of_pair, coefficient = springs
        if pairs is not None:
            found = [as_warp(t, wp.vec3) for t in (pairs.normal, pairs.weights_p, pairs.weights_q)]
            coefficient = self._energies[0].new_zeros(faces) if coefficient is None else coefficient
            rubbed, before = as_warp(coefficient, wp.float64), as_warp(self.before, wp.vec3d)
            self._kept += [pairs, *found, rubbed, before]
            inputs = [pairs.model, distance, stiffness_of_pair, rubbed, slip, before, *found, trial]
            commands["pairs"] = record(pair_kernel, faces, inputs, [energies[0], more])
        return commands

    def remember(self) -> None:
        """Takes `positions` as those at the start of the step, for damping and for friction between pairs."""
        self.before.copy_(self.positions)
        with torch_stream(self._device):
            for name in ("strain", "angle"):
                if name in self._commands:
                    self._commands[name].launch()

    def solve(self) -> torch.Tensor:
        """Lowers the energy from `positions`, which are changed in place and returned, float64 [V,3]."""
        commands = self._commands
        wanted = ["membrane", "pairs", "bending", "vertices", "accept"]
        evaluated = [name for name in wanted if name in commands]
        with torch_stream(self._device):
            self.search["point"].copy_(self.positions)
            commands["begin"].launch()
            for number in range(self.iterations):
                for name in evaluated:
                    commands[name].launch()
                if number == self.iterations - 1:
                    break
                self._solve()
                commands["direct"].launch()
                if self._early and self.search["done"].all():
                    break
        self.positions.copy_(self.search["point"])
        return self.positions

    def energy(self) -> torch.Tensor:
        """Energy [J] of the last accepted iterate of each group, float64 [B]."""
        return self.search["energy"]
