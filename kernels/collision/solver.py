"""Collision refinement: moves a garment out of the body with the least change of shape.

Supplement section 2, eq. 2 to 5, for the predicted positions Ṽ. For every vertex in C, the set with signed distance
below ε, U_i is the closest point of the body surface and n_i the outward direction there:

    E(V) = Σ_{i∈C} (n_i·(V_i - U_i) - ε)² + λ_lap ‖L (V - Ṽ)‖² + λ_reg ‖V - Ṽ‖²

(Eq. 2 as printed, ε + n·(V - U), would move vertices to a depth ε below the surface.) With D = V - Ṽ the minimiser
solves

    (B ⊗ I₃ + blockdiag(n_i n_iᵀ)) D = n_i (ε - n_i·(Ṽ_i - U_i)),    B = λ_lap LᵀL + λ_reg I

where B is constant per garment, the contacts are applied without a matrix, and the right-hand side is zero without
contacts. The unknowns are the contact forces, one per contact, if there is an inverse or a factor of B, otherwise D
(operator.py).

| symbol | code | what |
| --- | --- | --- |
| Ṽ, V | `vertices`, result | garment before and after |
| U_i | `anchor` | closest point of the body surface; if that is on the far side, of the plane of the face of entry |
| n_i | `normal` | sign (Ṽ_i - U_i) / |Ṽ_i - U_i|, or the face's normal at the surface and at entry; zero outside C |
| ε | `epsilon`, `distance` | distance kept from the body |
| L | `laplacian.cotangent_laplacian` | of the rest mesh, unitless |

These are contacts with a body (body_contacts.py). `solve` takes contacts of any source (contact_set.py).

The gradient with respect to Ṽ is the adjoint for fixed contacts: V = Ṽ - A⁻¹ n nᵀ Ṽ + const, so one more solve with A.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch

from warpgarment.kernels.launch import expect
from warpgarment.kernels.linear import factor
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.progress import Progress
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.mesh.laplacian import as_numpy, components, cotangent_laplacian
from warpgarment.kernels.operator import Packed, pack
from warpgarment.kernels.sdf.bodies import BodyMeshes

from . import compliance, compliance_rows
from .body_contacts import BodyContacts
from .compliance import Compliance
from .compliance_rows import Rows
from .contact_set import ContactFrame, Contacts, one_for_each_vertex
from .operator import Model, solved

TOLERANCE = 2e-6
"""Error of a solve in the energy norm [m].

Measured on skirts of 1,000 to 10,000 faces, 15 mm deep in a body, solved for displacements: the largest error of a
vertex is 0.02 to 0.03 mm at 1e-5 or 5e-6, and 0.009 mm at 2e-6. For contact forces see `operator.RESIDUAL`.
"""


class CollisionSolver:
    """Moves garments out of bodies, for a packed batch of rest meshes.

    Args:
        rest_vertices: Rest positions [m], float32 [V,3], on the device of the solver.
        faces: Vertex indices, int32 [F,3].
        lambda_lap: Weight of the change of the Laplacian.
        lambda_reg: Weight of the displacement; positive, or the system would be singular.
        max_iterations: Limit of iterations per solve; reaching it warns once.
        largest_compliance: Largest number of vertices of a component that is solved for contact forces through the
            dense inverse of B. With zero, no block is inverted.
        compliance_budget: Limit of the entries of all inverses together, 4 bytes each; a solve needs the same again.
        factor_budget: Limit of the entries of the factors of B, 12 bytes each, through which all other components are
            solved on a CPU. Components whose factor does not fit are solved by conjugate gradients for displacements.
        row_budget: Limit of the entries of the rows of inverses that these components keep, 4 bytes each. Components
            with more contacts than that are solved through the factor alone.
        one_core: Whether solves use the kernels for one CPU core; None does so on a CPU.

    Raises:
        ValueError: Shapes are wrong, indices or options are out of range, or rest faces have no area.
        TypeError: A dtype is wrong.
    """

    def __init__(
        self,
        rest_vertices: torch.Tensor,
        faces: torch.Tensor,
        *,
        lambda_lap: float = 0.5,
        lambda_reg: float = 1e-3,
        max_iterations: int = 5000,
        largest_compliance: int = compliance.LARGEST,
        compliance_budget: int = compliance.BUDGET,
        factor_budget: int = factor.BUDGET,
        row_budget: int = compliance_rows.BUDGET,
        one_core: bool | None = None,
    ) -> None:
        expect("rest_vertices", rest_vertices, (None, 3))
        expect("faces", faces, (None, 3), torch.int32, rest_vertices.device)
        if not lambda_lap >= 0:
            raise ValueError(f"lambda_lap must not be negative, got {lambda_lap}")
        for name, option in (("lambda_reg", lambda_reg), ("max_iterations", max_iterations)):
            if not option > 0:
                raise ValueError(f"{name} must be positive, got {option}")
        device, vertex_count = rest_vertices.device, len(rest_vertices)
        laplacian = cotangent_laplacian(rest_vertices, faces)
        base = lambda_lap * (laplacian.T @ laplacian) + lambda_reg * scipy.sparse.identity(vertex_count)
        vertex_component, _, count = components(vertex_count, as_numpy("faces", faces, np.int32))
        system = System.build(base.tocsr(), vertex_component, count, device)
        one_core = device.type == "cpu" if one_core is None else one_core
        dense = Compliance.build(base.tocsr(), system, largest_compliance, compliance_budget)
        budget = factor_budget if one_core else 0
        factors = Factor.build(base.tocsr(), system, explicit=False, budget=budget, skip=dense.base.cpu().numpy() >= 0)
        rows = Rows.build(system, factors, row_budget)
        owner = torch.from_numpy(vertex_component).to(device)
        self._model = Packed(pack(Model(system, dense, factors, rows, owner, one_core)))
        self._limits: dict[float, torch.Tensor] = {}
        self._progress = Progress("CollisionSolver")
        self._normal: torch.Tensor | None = None  # of the contacts of the last refinement
        self.vertex_count = vertex_count
        self.component_count = count
        self.device = device
        self.max_iterations = int(max_iterations)

    @property
    def iterations(self) -> int:
        """Number of iterations of the last refinement: the largest of all components, summed over the passes."""
        return self._progress.iterations

    def summary(self, before: torch.Tensor | None = None) -> torch.Tensor:
        """Report of the last refinement: iterations, number of components stopped by the limit, their largest error.

        float64 [3] on the solver's device, the error in metres; does not wait for the solve. An earlier summary
        `before` is added to it.
        """
        return self._progress.summary(before)

    def warn_if_stopped(self, stopped: float, error: float) -> None:
        """Warns, once, if components were stopped by the limit.

        Args:
            stopped: Number of components that were stopped, from a `summary` that was read from the device.
            error: Largest error of those components [m], from that summary.
        """
        self._progress.warn_if_stopped(stopped, self.component_count, error)

    @property
    def contacts(self) -> int:
        """Number of contacts in the first pass of the last refinement."""
        return 0 if self._normal is None else int(torch.count_nonzero((self._normal != 0).any(dim=1)))

    def refine(
        self,
        vertices: torch.Tensor,
        bodies: BodyMeshes,
        body_of_vertex: torch.Tensor | None = None,
        *,
        epsilon: float | torch.Tensor = 0.004,
        origin: torch.Tensor | None = None,
        passes: int = 1,
        tolerance: float = TOLERANCE,
    ) -> torch.Tensor:
        """Minimises eq. 5 of supplement section 2 for the contacts found at `vertices`.

        Differentiable in `vertices` with the contacts (which vertices, closest points, directions) held fixed.

        Args:
            vertices: Predicted positions [m], float32 [V,3].
            bodies: The bodies in the frame of `vertices`.
            body_of_vertex: Body of each vertex, int32 [V]; None if there is one body.
            epsilon: Distance to keep from the body [m]: a number, or float32 [V] with one for each vertex.
            origin: Position of each vertex if it had moved with its body [m], float32 [V,3]; NaN if unknown. A vertex
                past the middle of a limb is moved to the side on which it entered. None moves all vertices to the
                nearest point of the surface.
            passes: Number of times that contacts are found and solved, each time from the last result.
            tolerance: Error in the energy norm [m] at which the iteration stops. The default keeps every vertex within
                0.02 mm of the exact minimiser.

        Returns:
            Positions [m], float32 [V,3]; those of components without contacts are unchanged.

        Raises:
            ValueError: A shape or device is wrong, or an option is out of range.
            TypeError: A dtype is wrong.
        """
        expect("vertices", vertices, (self.vertex_count, 3), device=self.device)
        if body_of_vertex is not None:
            expect("body_of_vertex", body_of_vertex, (self.vertex_count,), torch.int32, self.device)
        if isinstance(epsilon, torch.Tensor):
            expect("epsilon", epsilon, (self.vertex_count,), device=self.device)
        elif not epsilon >= 0:
            raise ValueError(f"epsilon must not be negative, got {epsilon}")
        if origin is not None:
            expect("origin", origin, (self.vertex_count, 3), device=self.device)
        if passes < 1:
            raise ValueError(f"passes must be at least 1, got {passes}")
        limit = self._limit(tolerance)
        source = BodyContacts()
        frame = ContactFrame(bodies, body_of_vertex, epsilon=epsilon, origin=origin)
        for number in range(passes):
            vertices = self._solve(vertices, source.find(vertices, frame), limit, first=number == 0)
        return vertices

    def solve(self, vertices: torch.Tensor, contacts: Contacts, *, tolerance: float = TOLERANCE) -> torch.Tensor:
        """Minimises eq. 5 of supplement section 2 for contacts that a source has found at `vertices`.

        Differentiable in `vertices`; the contacts are constants.

        Args:
            vertices: Predicted positions [m], float32 [V,3].
            contacts: One contact for each vertex, K = V, without stencils.
            tolerance: Error in the energy norm [m] at which the iteration stops, as in `refine`.

        Returns:
            Positions [m], float32 [V,3]; those of components without contacts are unchanged.

        Raises:
            ValueError: Contacts have stencils, a shape or device is wrong, or the tolerance is not positive.
            TypeError: A dtype is wrong.
        """
        expect("vertices", vertices, (self.vertex_count, 3), device=self.device)
        one_for_each_vertex(contacts)
        for name, tensor in (("normal", contacts.normal), ("anchor", contacts.anchor)):
            expect(f"contacts.{name}", tensor, (self.vertex_count, 3), torch.float64, self.device)
        if isinstance(contacts.distance, torch.Tensor):
            kind = contacts.distance.dtype if contacts.distance.is_floating_point() else torch.float64
            expect("contacts.distance", contacts.distance, (self.vertex_count,), kind, self.device)
        return self._solve(vertices, contacts, self._limit(tolerance), first=True)

    def _limit(self, tolerance: float) -> torch.Tensor:
        """The tolerance of each component, float64 [C]."""
        if not tolerance > 0:
            raise ValueError(f"tolerance must be positive, got {tolerance}")
        if tolerance not in self._limits:
            limit = torch.full((self.component_count,), tolerance, dtype=torch.float64, device=self.device)
            self._limits = {tolerance: limit}
        return self._limits[tolerance]

    def _solve(self, vertices: torch.Tensor, contacts: Contacts, limit: torch.Tensor, *, first: bool) -> torch.Tensor:
        """One solve; the first one of a refinement resets the report."""
        normal, anchor, distance, *_ = contacts
        if not isinstance(distance, torch.Tensor):
            distance = torch.full((1,), distance, dtype=torch.float64, device=self.device)
        given = normal, anchor, distance.double(), limit
        if first:
            self._normal = normal
        vertices, report, error = solved(vertices, *given, self._model, self.max_iterations)
        self._progress.record(report, error, self.max_iterations, add=not first)
        return vertices


def refine(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    body_vertices: torch.Tensor,
    body_faces: torch.Tensor,
    *,
    rest_vertices: torch.Tensor | None = None,
    epsilon: float = 0.004,
    lambda_lap: float = 0.5,
    lambda_reg: float = 1e-3,
    passes: int = 1,
) -> torch.Tensor:
    """Refines one garment on one body with a new `CollisionSolver`.

    Args:
        vertices: Predicted positions [m], float32 [V,3].
        faces: Vertex indices, int32 [F,3].
        body_vertices: Body positions [m], float32 [U,3].
        body_faces: Body vertex indices, int32 [G,3].
        rest_vertices: Rest positions [m], float32 [V,3], for the Laplacian; None takes `vertices`.
        epsilon, passes: Options of `CollisionSolver.refine`.
        lambda_lap, lambda_reg: Options of `CollisionSolver`.

    Returns:
        Positions [m], float32 [V,3]. Differentiable in `vertices` with the contacts held fixed.

    Raises:
        ValueError, TypeError: As for `CollisionSolver` and `CollisionSolver.refine`.
    """
    expect("vertices", vertices, (None, 3))
    rest = vertices if rest_vertices is None else rest_vertices
    expect("rest_vertices", rest, tuple(vertices.shape), device=vertices.device)
    solver = CollisionSolver(rest.detach(), faces, lambda_lap=lambda_lap, lambda_reg=lambda_reg)
    bodies = BodyMeshes(body_vertices.detach(), body_faces)
    return solver.refine(vertices, bodies, epsilon=epsilon, passes=passes)
