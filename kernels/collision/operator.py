"""The collision refinement for given contacts, as a differentiable torch operator. Equations: solver.py.

A component is solved by the first of these methods for which its solver has the matrices:

| method | components | file |
| --- | --- | --- |
| contact forces through the inverse of B | moderate size, CPU | forces_inverse_cpu.py |
| | moderate size, GPU | forces_inverse_gpu.py |
| contact forces through rows of the inverse | larger, CPU | compliance_rows.py, forces_inverse_cpu.py |
| contact forces through a factor of B | with more contacts than there is room for rows, CPU | forces_factor_cpu.py |
| displacements by conjugate gradients | all others | linear/conjugate_gradients.py |
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgarment.kernels.launch import as_argument, launch, torch_stream
from warpgarment.kernels.linear import conjugate_gradients, triangular
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.operator import allocate, made_of, unpack
from warpgarment.kernels.registered import operator

from . import forces_factor_cpu, forces_inverse_cpu, forces_inverse_gpu
from .compliance import Compliance
from .compliance_rows import Rows, lines_of
from .contact_set import contact_gap

ADJOINT_TOLERANCE = 1e-6
"""Error of the adjoint solve in the energy norm as a share of the norm of its solution."""
RESIDUAL = 10.0
"""Residual at which iterations for contact forces stop, in units of the tolerance.

The residual is a bound of the error in the energy norm, which is much smaller. Measured on the bundled dress of 500 to
10,000 faces with 6 to 2,839 contacts: at 2e-5 m the largest error of a vertex is 0.008 mm, at 1e-4 m it is 0.03 mm.
"""


class Model(NamedTuple):
    """The constants of a solver, which the operators take as one list (`operator.pack`)."""

    system: System
    dense: Compliance
    factor: Factor
    rows: Rows
    vertex_component: torch.Tensor
    """Component of each vertex, int32 [V]."""
    one_core: bool
    """Whether solves use the kernels for one CPU core."""


def _solve(
    model: Model,
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    load: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solves (B + N Nᵀ) D = N c, or with a load g on all vertices (B + N Nᵀ) λ = g for n·λ.

    Returns:
        D [m], float64 [V,3] (undefined with a load); forces y, or n·λ with a load, float64 [V]; iterations, int32 [C];
        error [m], float64 [C].
    """
    system, dense, factor, rows, vertex_component, one_core = model
    count, device = len(tolerance), normal.device
    force = torch.zeros(len(normal), dtype=torch.float64, device=device)
    if dense.inverted + factor.factored < count:
        right = normal * gap[:, None] if load is None else load
        if dense.inverted + factor.factored:  # all other loads are zero, which takes no iterations
            left = (dense.base < 0) & (factor.base < 0)
            right = right * left[vertex_component.long(), None]
        increment, report, error = conjugate_gradients.solve(system, normal, right, tolerance, relative, max_iterations)
        force += (normal * increment).sum(1) if load is not None else 0.0
    else:
        increment = allocate(normal.shape, torch.float64, device)
        report, error = (allocate((count,), dtype, device) for dtype in (torch.int32, torch.float64))
    results = increment, report, error
    limit = RESIDUAL * tolerance
    if dense.inverted and one_core:
        force += forces_inverse_cpu.solve(system, dense, normal, gap, limit, relative, max_iterations, *results)
    elif dense.inverted:
        listed = forces_inverse_gpu.list_contacts(system, normal)
        y = forces_inverse_gpu.solve(system, dense, listed, normal, gap, limit, relative, max_iterations, report, error)
        if load is None:
            forces_inverse_gpu.displace(system, dense, vertex_component, listed, normal, y, increment)
        force += y
    if factor.factored:
        lines = lines_of(system, factor, rows, vertex_component, normal)
        solved = normal, gap, limit, relative, max_iterations, *results
        force += forces_inverse_cpu.solve_by_rows(system, factor, rows, lines, *solved)
        left = torch.where(lines.base < 0, factor.base, -1)
        if (left >= 0).any():
            force += forces_factor_cpu.solve(system, factor._replace(base=left), *solved)
    return increment, force, report, error


@operator("warpgarment::collision_solve")
def collision_solve(
    vertices: torch.Tensor,
    normal: torch.Tensor,
    anchor: torch.Tensor,
    distance: torch.Tensor,
    tolerance: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The minimiser of eq. 5 for given contacts: positions [m], and iterations and error [m] of each component.

    `distance` is float64, of each contact or one for all.
    """
    vertices, normal, anchor = vertices.contiguous(), normal.contiguous(), anchor.contiguous()
    gap = allocate((len(vertices),), torch.float64, vertices.device)
    with torch_stream(vertices.device) as device:
        launch(
            contact_gap,
            len(vertices),
            [
                as_argument(vertices, wp.vec3),
                as_argument(normal, wp.vec3d),
                as_argument(anchor, wp.vec3d),
                as_argument(distance, wp.float64),
                as_argument(gap, wp.float64),
            ],
            device,
        )
    increment, _, report, error = _solve(made_of(model, _unpacked), normal, gap, tolerance, 0.0, max_iterations)
    return (vertices.double() + increment).to(torch.float32), report, error


@collision_solve.register_fake
def _(
    vertices: torch.Tensor,
    normal: torch.Tensor,
    anchor: torch.Tensor,
    distance: torch.Tensor,
    tolerance: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    count = tolerance.shape[0]
    return (
        torch.empty_like(vertices, memory_format=torch.contiguous_format),
        vertices.new_empty(count, dtype=torch.int32),
        vertices.new_empty(count, dtype=torch.float64),
    )


@operator("warpgarment::collision_solve_backward")
def collision_solve_backward(
    grad: torch.Tensor, normal: torch.Tensor, tolerance: torch.Tensor, model: list[torch.Tensor], max_iterations: int
) -> torch.Tensor:
    """g - n (n·λ) with A λ = g; n·λ is the force of the contacts for the gap n·(B⁻¹ g)."""
    normal, g = normal.contiguous(), grad.double().contiguous()
    parts = made_of(model, _unpacked)
    system, dense, factor, _, vertex_component, _ = parts
    gap = torch.zeros(len(g), dtype=torch.float64, device=g.device)
    if dense.inverted:
        gap = forces_inverse_gpu.respond(system, dense, vertex_component, normal, g)
    if factor.factored:
        response = torch.zeros_like(g)
        triangular.solve(system, factor, vertex_component, g, response)
        gap += (normal * response).sum(1)
    exactly = torch.zeros_like(tolerance)
    _, force, _, _ = _solve(parts, normal, gap, exactly, ADJOINT_TOLERANCE, max_iterations, load=g)
    return (g - normal * force[:, None]).to(torch.float32)


@collision_solve_backward.register_fake
def _(
    grad: torch.Tensor, normal: torch.Tensor, tolerance: torch.Tensor, model: list[torch.Tensor], max_iterations: int
) -> torch.Tensor:
    return torch.empty_like(grad, memory_format=torch.contiguous_format)


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[torch.Tensor, ...]:
        _, ctx.normal, _, _, ctx.tolerance, ctx.model, ctx.max_iterations = given
        output: tuple[torch.Tensor, ...] = collision_solve.function(*given)
        ctx.mark_non_differentiable(*output[1:])
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor, *_: None) -> tuple[Any, ...]:
        given = ctx.normal, ctx.tolerance, ctx.model, ctx.max_iterations
        return collision_solve_backward.function(gradient, *given), None, None, None, None, None, None


def solved(*given: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`collision_solve` past torch's dispatcher, of the same arguments."""
    result: tuple[torch.Tensor, torch.Tensor, torch.Tensor] = collision_solve.directly(_Solve, *given)
    return result


def _unpacked(model: list[torch.Tensor]) -> Model:
    return unpack(model, Model)


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    _, normal, _, _, tolerance, model, max_iterations = inputs
    ctx.save_for_backward(normal, tolerance, *model)
    ctx.max_iterations = max_iterations
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx: Any, grad: torch.Tensor, _iterations: None, _error: None) -> tuple[Any, ...]:
    normal, tolerance, *model = ctx.saved_tensors
    solve = torch.ops.warpgarment.collision_solve_backward
    return solve(grad, normal, tolerance, model, ctx.max_iterations), None, None, None, None, [None] * len(model), None


collision_solve.register_autograd(_backward, setup_context=_setup)
