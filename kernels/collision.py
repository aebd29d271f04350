"""Collision refinement: the least change of shape that lifts a garment out of the body.

Supplement section 2, eq. 2 to 5, for the predicted positions Ṽ. For every vertex in C, the set with signed distance
below ε, U_i is the closest point of the body surface and n_i the outward direction there:

    E(V) = Σ_{i∈C} (n_i·(V_i - U_i) - ε)² + λ_lap ‖L (V - Ṽ)‖² + λ_reg ‖V - Ṽ‖²

(Eq. 2 as printed, ε + n·(V - U), would draw vertices ε below the surface.) With D = V - Ṽ the minimiser solves

    (B ⊗ I₃ + blockdiag(n_i n_iᵀ)) D = n_i (ε - n_i·(Ṽ_i - U_i)),    B = λ_lap LᵀL + λ_reg I

where B is constant per garment, the contacts are applied without a matrix, and the right-hand side is zero without
contacts. Components of moderate size are solved for the contact forces instead (compliance.py), the others by cg.py.

| symbol | code | what |
| --- | --- | --- |
| Ṽ, V | `vertices`, result | garment before and after |
| U_i | `closest` | closest point of the body surface |
| n_i | `normal` | sign (Ṽ_i - U_i) / |Ṽ_i - U_i|, or the body face's normal right at the surface; zero outside C |
| ε | `epsilon` | distance kept from the body |
| L | `laplacian.cotangent_laplacian` | of the rest mesh, unitless |

The gradient with respect to Ṽ is the adjoint for fixed contacts: V = Ṽ - A⁻¹ n nᵀ Ṽ + const, so one more solve with A.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse
import torch
import warp as wp

from . import cg, compliance
from ._operator import allocate
from ._torch import expect, torch_stream
from .body_meshes import BodyMeshes
from .compliance import Compliance
from .laplacian import as_numpy, components, cotangent_laplacian

TOLERANCE = 2e-6
"""Error of a solve in the energy norm [m].

Measured on skirts of 1,000 to 10,000 faces, 15 mm deep in a body: the worst vertex is off by 0.02 to 0.03 mm at 1e-5 or
5e-6 and 0.009 mm at 2e-6 where displacements are solved for; 0.0004 mm at any of them where contact forces are.
"""
ADJOINT_TOLERANCE = 1e-6
"""Error of the adjoint solve in the energy norm as a share of the norm of its solution."""
AT_SURFACE = wp.constant(wp.float64(1e-7))
"""Below this distance [m] the direction from the closest point is noise, and the face's normal is taken."""


@wp.func
def closest_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """The point of a triangle closest to p: the foot of the perpendicular if inside, or else on the nearest edge."""
    n = wp.cross(b - a, c - a)
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    outside = wp.int32(0)
    best = a
    for k in range(3):
        start = wp.where(k == 0, a, wp.where(k == 1, b, c))
        edge = wp.where(k == 0, b, wp.where(k == 1, c, a)) - start
        if wp.dot(wp.cross(n, edge), p - start) < zero:
            outside += 1
        t = wp.clamp(wp.dot(p - start, edge) / wp.max(wp.dot(edge, edge), wp.float64(1e-300)), zero, one)
        q = start + t * edge
        if wp.length_sq(p - q) < wp.length_sq(p - best):
            best = q
    if outside == 0 and wp.length_sq(n) > zero:
        best = p - n * (wp.dot(n, p - a) / wp.length_sq(n))
    return best


@wp.kernel(enable_backward=False)
def find_contacts(
    # Body:
    body_vertices: wp.array[wp.vec3],
    body_faces: wp.array2d[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    distance: wp.array[wp.float32],
    face: wp.array[wp.int32],
    epsilon: wp.float64,
    # Out:
    closest: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
):
    """Closest points and outward directions at the vertices closer than epsilon, zero elsewhere.

    The closest point is computed again in float64: of a direction over 0.1 mm, float32 leaves three digits.
    """
    i = wp.tid()
    n = wp.vec3d()
    u = wp.vec3d()
    if wp.float64(distance[i]) < epsilon:
        p = wp.vec3d(vertices[i])
        j = face[i]
        a = wp.vec3d(body_vertices[body_faces[j, 0]])
        b = wp.vec3d(body_vertices[body_faces[j, 1]])
        c = wp.vec3d(body_vertices[body_faces[j, 2]])
        u = closest_on_triangle(p, a, b, c)
        length = wp.length(p - u)
        if length > AT_SURFACE:
            n = (p - u) / length
            if distance[i] < 0.0:
                n = -n
        else:
            n = wp.normalize(wp.cross(b - a, c - a))
    closest[i] = u
    normal[i] = n


@wp.kernel(enable_backward=False)
def contact_gap(
    # In:
    vertices: wp.array[wp.vec3],
    normal: wp.array[wp.vec3d],
    closest: wp.array[wp.vec3d],
    epsilon: wp.float64,
    # Out:
    gap: wp.array[wp.float64],
):
    """c = ε - n·(Ṽ - U) at the contacts, zero elsewhere."""
    i = wp.tid()
    n = normal[i]
    c = wp.float64(0.0)
    if wp.dot(n, n) > c:
        c = epsilon - wp.dot(n, wp.vec3d(vertices[i]) - closest[i])
    gap[i] = c


def _split(model: list[torch.Tensor]) -> tuple[cg.System, Compliance, torch.Tensor]:
    """The tensors of a solver travel through the operators as one list."""
    return cg.System(*model[:6]), Compliance(*model[6:11]), model[11]


def _without_compliance(load: torch.Tensor, dense: Compliance, vertex_component: torch.Tensor) -> torch.Tensor:
    """A load [V,3] with zeros on the components that are solved for contact forces."""
    return load * (dense.base < 0)[vertex_component, None] if int(dense.sizes[1]) else load


def _reports(tolerance: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Room for iterations and error of each component."""
    return tuple(allocate(tolerance.shape, dtype, tolerance.device) for dtype in (torch.int32, torch.float64))


@torch.library.custom_op("warpgarment::collision_solve", mutates_args=())
def collision_solve(
    vertices: torch.Tensor,
    normal: torch.Tensor,
    closest: torch.Tensor,
    epsilon: float,
    tolerance: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The minimiser of eq. 5 for given contacts. Returns vertices, iterations and error per component."""
    vertices, normal, closest = vertices.contiguous(), normal.contiguous(), closest.contiguous()
    system, dense, vertex_component = _split(model)
    gap = allocate((len(vertices),), torch.float64, vertices.device)
    with torch_stream(vertices.device) as device:
        wp.launch(
            contact_gap,
            dim=len(vertices),
            inputs=[
                cg.view(vertices, wp.vec3),
                cg.view(normal, wp.vec3d),
                cg.view(closest, wp.vec3d),
                float(epsilon),
                cg.view(gap, wp.float64),
            ],
            device=device,
        )
    if int(dense.sizes[2]):
        load = _without_compliance(normal * gap[:, None], dense, vertex_component)
        increment, report, error = cg.solve(system, normal, load, tolerance, 0.0, max_iterations)
    else:
        increment = allocate(normal.shape, torch.float64, vertices.device)
        report, error = _reports(tolerance)
    if int(dense.sizes[1]):
        listed = compliance.list_contacts(system, normal)
        force = compliance.solve(system, dense, listed, normal, gap, tolerance, 0.0, max_iterations, report, error)
        compliance.displace(system, dense, vertex_component, listed, normal, force, increment)
    return (vertices.double() + increment).to(torch.float32), report, error


@collision_solve.register_fake
def _(vertices, normal, closest, epsilon, tolerance, model, max_iterations):
    count = tolerance.shape[0]
    return (
        torch.empty_like(vertices, memory_format=torch.contiguous_format),
        vertices.new_empty(count, dtype=torch.int32),
        vertices.new_empty(count, dtype=torch.float64),
    )


@torch.library.custom_op("warpgarment::collision_solve_backward", mutates_args=())
def collision_solve_backward(
    grad: torch.Tensor, normal: torch.Tensor, tolerance: torch.Tensor, model: list[torch.Tensor], max_iterations: int
) -> torch.Tensor:
    """g - n (n·λ) with A λ = g; n·λ is the force that the gap n·(B⁻¹ g) would cause."""
    normal, g = normal.contiguous(), grad.double().contiguous()
    system, dense, vertex_component = _split(model)
    exactly = torch.zeros_like(tolerance)
    force = torch.zeros(len(g), dtype=torch.float64, device=g.device)
    if int(dense.sizes[2]):
        load = _without_compliance(g, dense, vertex_component)
        adjoint, _, _ = cg.solve(system, normal, load, exactly, ADJOINT_TOLERANCE, max_iterations)
        force += (normal * adjoint).sum(1)
    if int(dense.sizes[1]):
        listed = compliance.list_contacts(system, normal)
        gap = compliance.respond(system, dense, vertex_component, normal, g)
        report, error = _reports(tolerance)
        force += compliance.solve(
            system, dense, listed, normal, gap, exactly, ADJOINT_TOLERANCE, max_iterations, report, error
        )
    return (g - normal * force[:, None]).to(torch.float32)


@collision_solve_backward.register_fake
def _(grad, normal, tolerance, model, max_iterations):
    return torch.empty_like(grad, memory_format=torch.contiguous_format)


def _setup(ctx, inputs, output):
    _, normal, _, _, tolerance, model, max_iterations = inputs
    ctx.save_for_backward(normal, tolerance, *model)
    ctx.max_iterations = max_iterations
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx, grad, _iterations, _error):
    normal, tolerance, *model = ctx.saved_tensors
    solve = torch.ops.warpgarment.collision_solve_backward
    return solve(grad, normal, tolerance, model, ctx.max_iterations), None, None, None, None, [None] * len(model), None


collision_solve.register_autograd(_backward, setup_context=_setup)


class CollisionSolver:
    """Moves garments out of bodies, for a packed batch of rest meshes.

    Args:
        rest_vertices: Rest positions [m], float32 [V,3]; their device is the solver's.
        faces: Vertex indices, int32 [F,3].
        lambda_lap: Weight of the change of the Laplacian.
        lambda_reg: Weight of the displacement; positive, or the system would be singular.
        max_iterations: Limit per solve; reaching it warns once.
        largest_compliance: Components of up to this many vertices are solved through the dense inverse of B, for the
            contact forces, the others by conjugate gradients for the displacement. Zero never inverts.
        compliance_budget: Entries of all the inverses together, 4 bytes each and as many again while solving; what
            does not fit is solved by conjugate gradients.

    Raises:
        ValueError: Wrong shapes, indices out of range, rest faces without area, options out of range.
        TypeError: Wrong dtypes.
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
        system = cg.System.build(base.tocsr(), vertex_component, count, device)
        dense = Compliance.build(base.tocsr(), system, largest_compliance, compliance_budget)
        self._model = [*system, *dense, torch.from_numpy(vertex_component).to(device)]
        self._progress = cg.Progress("CollisionSolver")
        self._contacts: torch.Tensor | None = None
        self.vertex_count = vertex_count
        self.component_count = count
        self.device = device
        self.max_iterations = int(max_iterations)

    @property
    def iterations(self) -> int:
        """Iterations of the last refinement: the largest of all components, summed over the passes."""
        return self._progress.iterations

    @property
    def contacts(self) -> int:
        """Vertices closer than epsilon in the first pass of the last refinement."""
        return 0 if self._contacts is None else int(self._contacts)

    def refine(
        self,
        vertices: torch.Tensor,
        bodies: BodyMeshes,
        body_of_vertex: torch.Tensor | None = None,
        *,
        epsilon: float | torch.Tensor = 0.004,
        passes: int = 1,
        tolerance: float = TOLERANCE,
    ) -> torch.Tensor:
        """Minimises eq. 5 of supplement section 2 for the contacts found at `vertices`.

        Differentiable in `vertices` with the contacts (which vertices, closest points, directions) held fixed.

        Args:
            vertices: Predicted positions [m], float32 [V,3].
            bodies: The bodies in the frame of `vertices`.
            body_of_vertex: Body of each vertex, int32 [V]; None where there is one body.
            epsilon: Distance kept from the body [m]: a number, or float32 [V] with one for each vertex.
            passes: How often detection and solve are done, each from the result of the one before.
            tolerance: Where the iteration stops: error in the energy norm [m]. The default keeps every vertex within
                0.02 mm of the exact minimiser.

        Returns:
            Positions [m], float32 [V,3]; components without contacts come back unchanged.

        Raises:
            ValueError: Wrong shape or device, options out of range.
            TypeError: Wrong dtype.
        """
        expect("vertices", vertices, (self.vertex_count, 3), device=self.device)
        if body_of_vertex is not None:
            expect("body_of_vertex", body_of_vertex, (self.vertex_count,), torch.int32, self.device)
        each = isinstance(epsilon, torch.Tensor)
        if isinstance(epsilon, torch.Tensor):
            expect("epsilon", epsilon, (self.vertex_count,), device=self.device)
        elif not epsilon >= 0:
            raise ValueError(f"epsilon must not be negative, got {epsilon}")
        if not tolerance > 0:
            raise ValueError(f"tolerance must be positive, got {tolerance}")
        if passes < 1:
            raise ValueError(f"passes must be at least 1, got {passes}")
        limit = torch.full((self.component_count,), tolerance, dtype=torch.float64, device=self.device)
        for number in range(passes):
            query = bodies.query(vertices.detach(), body_of_vertex, within=epsilon)
            closest, normal = contacts(vertices, query.distance, query.face, bodies, math.inf if each else epsilon)
            if isinstance(epsilon, torch.Tensor):  # n.(V - U) - e = n.(V - (U + e n)), so the solver's epsilon is zero
                normal = torch.where((query.distance < epsilon)[:, None], normal, 0.0)
                closest = closest + epsilon[:, None] * normal
            if number == 0:
                self._contacts = torch.count_nonzero((normal != 0).any(dim=1))
            vertices, report, error = torch.ops.warpgarment.collision_solve(
                vertices, normal, closest, 0.0 if each else epsilon, limit, self._model, self.max_iterations
            )
            self._progress.record(report, error, self.max_iterations, add=number > 0)
        return vertices


def contacts(
    vertices: torch.Tensor, distance: torch.Tensor, face: torch.Tensor, bodies: BodyMeshes, epsilon: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The set C: what a body query found closer than epsilon.

    Args:
        vertices: Positions [m], float32 [V,3].
        distance: Signed distance [m], float32 [V], negative inside.
        face: Nearest body face, int32 [V].
        bodies: The bodies in the frame of `vertices`.
        epsilon: Distance kept from the body [m].

    Returns:
        Closest points [m] and outward directions, float64 [V,3]; zero at vertices that are not in C.
    """
    vertices, body_vertices, body_faces = vertices.detach().contiguous(), bodies.vertices, bodies.faces
    closest, normal = allocate((2, len(vertices), 3), torch.float64, vertices.device)
    with torch_stream(vertices.device) as device:
        wp.launch(
            find_contacts,
            dim=len(vertices),
            inputs=[
                cg.view(body_vertices, wp.vec3),
                cg.view(body_faces, wp.int32),
                cg.view(vertices, wp.vec3),
                cg.view(distance, wp.float32),
                cg.view(face, wp.int32),
                float(epsilon),
                cg.view(closest, wp.vec3d),
                cg.view(normal, wp.vec3d),
            ],
            device=device,
        )
    return closest, normal


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
    """One garment and one body: builds a `CollisionSolver` and refines once.

    Args:
        vertices: Predicted positions [m], float32 [V,3].
        faces: Vertex indices, int32 [F,3].
        body_vertices: Body positions [m], float32 [U,3].
        body_faces: Body vertex indices, int32 [G,3].
        rest_vertices: Rest positions [m], float32 [V,3], for the Laplacian; `vertices` when None.
        epsilon, lambda_lap, lambda_reg, passes: As in `CollisionSolver`.

    Returns:
        Positions [m], float32 [V,3]. Differentiable in `vertices` with the contacts held fixed.

    Raises:
        ValueError, TypeError: As `CollisionSolver`.
    """
    expect("vertices", vertices, (None, 3))
    rest = vertices if rest_vertices is None else rest_vertices
    expect("rest_vertices", rest, tuple(vertices.shape), device=vertices.device)
    solver = CollisionSolver(rest.detach(), faces, lambda_lap=lambda_lap, lambda_reg=lambda_reg)
    bodies = BodyMeshes(body_vertices.detach(), body_faces)
    return solver.refine(vertices, bodies, epsilon=epsilon, passes=passes)
