"""The Poisson solve as a differentiable torch operator. Equations and symbols: solver.py."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgarment.kernels.launch import as_argument, launch, launch_rows, launch_tiled, torch_stream
from warpgarment.kernels.linear import conjugate_gradients, triangular
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System, block_dim
from warpgarment.kernels.operator import allocate, made_of, unpack
from warpgarment.kernels.registered import operator

from .kernels import phi_adjoint, place, place_adjoint, right_hand_side

ADJOINT_TOLERANCE = 1e-6
"""Error of the adjoint solve in the energy norm as a share of the norm of its solution."""

# The tensors of a solver are passed to the operators as one list, in this order, followed by those of `Matrix`.
MODEL = (
    ("rest_vertices", wp.vec3),
    ("faces", wp.int32),
    ("half_cotangent", wp.float64),
    ("corner_start", wp.int32),
    ("corners", wp.int32),
    ("corner_edge", wp.vec3d),
    ("pin_of_vertex", wp.int32),
    ("pin_stiffness", wp.float64),
    ("pins", None),
    ("vertex_component", None),
    ("pins_in_component", None),
    ("kind", wp.int32),
    ("centroid_weight", wp.float64),
    ("no_normal", wp.vec3d),
    ("tolerance", None),
)


class Matrix(NamedTuple):
    """The matrix of a solver."""

    system: System
    factor: Factor


def _views(model: list[torch.Tensor]) -> dict[str, object]:
    return made_of(model, _made_views)


def _made_views(model: list[torch.Tensor]) -> dict[str, object]:
    tensors = _named(model)
    return {name: as_argument(tensors[name], dtype) for name, dtype in MODEL if dtype is not None}


def _start_rows(model: list[torch.Tensor]) -> list[object]:
    system = matrix_of(model).system
    return [as_argument(system.start, wp.int32), as_argument(system.rows, wp.int32)]


def _solve(
    model: list[torch.Tensor], rhs: torch.Tensor, tolerance: torch.Tensor, relative: float, max_iterations: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solves (L + W) D = g: directly where there is a factor, otherwise by conjugate gradients.

    Returns as `conjugate_gradients.solve` does: D [m], float64 [V,3], iterations and error of each component.
    """
    system, factor = matrix_of(model)
    tensors = _named(model)
    if factor.unfactored:
        load = factor.without(rhs, tensors["vertex_component"])
        solution, report, error = conjugate_gradients.solve(
            system, tensors["no_normal"], load, tolerance, relative, max_iterations
        )
    else:
        solution = allocate(rhs.shape, torch.float64, rhs.device)
        report, error = torch.zeros_like(tolerance, dtype=torch.int32), torch.zeros_like(tolerance)
    triangular.solve(system, factor, tensors["vertex_component"], rhs, solution)
    return solution, report, error


def _named(model: list[torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor for (name, _), tensor in zip(MODEL, model[: len(MODEL)], strict=True)}


def matrix_of(model: list[torch.Tensor]) -> Matrix:
    """The matrix, taken from the tensors of a solver."""
    return made_of(model, _made_matrix)


def _made_matrix(model: list[torch.Tensor]) -> Matrix:
    return unpack(model[len(MODEL) :], Matrix)


@operator("warpgarment::poisson_solve")
def poisson_solve(
    phi: torch.Tensor,
    mean: torch.Tensor,
    pin_target: torch.Tensor,
    initial: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The solve as an operator on tensors alone; see `PoissonSolver.solve` for the first four arguments.

    Args:
        phi: Deformation gradients, float32 [F,3,3].
        mean: Wanted mean of the face centroids of each component [m], float32 [C,3].
        pin_target: Positions of the pins [m], float32 [P,3].
        initial: Guess of the positions [m], float32 [V,3].
        model: Tensors of the solver, in the order of `MODEL`, followed by those of `Matrix`.
        max_iterations: Limit of conjugate gradients per component.

    Returns:
        Positions [m], float32 [V,3]; iterations, int32 [C]; estimated error in the energy norm [m], float64 [C].
    """
    tensors, m, count = _named(model), _views(model), len(mean)
    phi, mean, pin_target = phi.contiguous(), mean.contiguous(), pin_target.contiguous()
    guess = initial.to(torch.float64, copy=True, memory_format=torch.contiguous_format)
    if len(pin_target):  # a pinned component starts with the mean translation of its pins
        pins = tensors["pins"]
        offset = torch.zeros((count, 3), dtype=torch.float64, device=phi.device)
        offset.index_add_(0, tensors["vertex_component"][pins], pin_target.double() - guess[pins])
        guess += (offset / tensors["pins_in_component"].clamp(min=1.0))[tensors["vertex_component"]]
    rhs = allocate(guess.shape, torch.float64, phi.device)
    vertices = allocate(guess.shape, torch.float32, phi.device)
    if count == 0:
        return vertices, vertices.new_empty(0, dtype=torch.int32), vertices.new_empty(0, dtype=torch.float64)
    with torch_stream(phi.device) as device:
        launch_rows(
            right_hand_side,
            len(guess),
            inputs=[
                as_argument(tensors["faces"], wp.vec3i),
                as_argument(tensors["half_cotangent"], wp.vec3d),
                m["corner_start"],
                m["corners"],
                m["corner_edge"],
                m["pin_of_vertex"],
                m["pin_stiffness"],
                as_argument(phi, wp.mat33),
                as_argument(guess, wp.vec3d),
                as_argument(pin_target, wp.vec3),
                as_argument(rhs, wp.vec3d),
            ],
            outputs=[],
            device=device,
        )
        increment, report, error = _solve(model, rhs, tensors["tolerance"], 0.0, max_iterations)
        launch_tiled(
            place,
            count,
            [
                *_start_rows(model),
                m["kind"],
                m["centroid_weight"],
                as_argument(guess, wp.vec3d),
                as_argument(increment, wp.vec3d),
                as_argument(mean, wp.vec3),
                as_argument(vertices, wp.vec3),
            ],
            device,
            block_dim=block_dim(phi.device, len(guess), count),
        )
    return vertices, report, error


@poisson_solve.register_fake
def _(
    phi: torch.Tensor,
    mean: torch.Tensor,
    pin_target: torch.Tensor,
    initial: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    count = mean.shape[0]
    return (
        torch.empty_like(initial, memory_format=torch.contiguous_format),
        mean.new_empty(count, dtype=torch.int32),
        mean.new_empty(count, dtype=torch.float64),
    )


@operator("warpgarment::poisson_solve_backward")
def poisson_solve_backward(
    grad_vertices: torch.Tensor, mean: torch.Tensor, model: list[torch.Tensor], max_iterations: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients with respect to phi, mean and pin_target: one solve with the same matrix."""
    tensors, m, count = _named(model), _views(model), len(mean)
    grad_vertices = grad_vertices.contiguous()
    rhs = allocate(grad_vertices.shape, torch.float64, mean.device)
    grad_mean = allocate(mean.shape, torch.float32, mean.device)
    grad_phi = allocate((len(tensors["faces"]), 3, 3), torch.float32, mean.device)
    if count == 0:
        return grad_phi, grad_mean, mean.new_empty((0, 3))
    with torch_stream(mean.device) as device:
        launch_tiled(
            place_adjoint,
            count,
            [
                *_start_rows(model),
                m["kind"],
                m["centroid_weight"],
                as_argument(grad_vertices, wp.vec3),
                as_argument(rhs, wp.vec3d),
                as_argument(grad_mean, wp.vec3),
            ],
            device,
            block_dim=block_dim(mean.device, len(rhs), count),
        )
        exactly = torch.zeros_like(tensors["tolerance"])
        adjoint, _, _ = _solve(model, rhs, exactly, ADJOINT_TOLERANCE, max_iterations)
        launch(
            phi_adjoint,
            len(grad_phi),
            [
                m["rest_vertices"],
                m["faces"],
                m["half_cotangent"],
                as_argument(adjoint, wp.vec3d),
                as_argument(grad_phi, wp.float32),
            ],
            device,
        )
    pins = tensors["pins"]
    grad_pins = (tensors["pin_stiffness"][pins, None] * adjoint[pins]).to(torch.float32)
    return grad_phi, grad_mean, grad_pins


@poisson_solve_backward.register_fake
def _(
    grad_vertices: torch.Tensor, mean: torch.Tensor, model: list[torch.Tensor], max_iterations: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    tensors = _named(model)
    return (
        mean.new_empty((tensors["faces"].shape[0], 3, 3)),
        torch.empty_like(mean, memory_format=torch.contiguous_format),
        mean.new_empty((tensors["pins"].shape[0], 3)),
    )


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[torch.Tensor, ...]:
        _, ctx.mean, _, _, ctx.model, ctx.max_iterations = given
        output: tuple[torch.Tensor, ...] = poisson_solve.function(*given)
        ctx.mark_non_differentiable(*output[1:])
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor, *_: None) -> tuple[Any, ...]:
        return *poisson_solve_backward.function(gradient, ctx.mean, ctx.model, ctx.max_iterations), None, None, None


def solved(*given: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`poisson_solve` past torch's dispatcher, of the same arguments."""
    result: tuple[torch.Tensor, torch.Tensor, torch.Tensor] = poisson_solve.directly(_Solve, *given)
    return result


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
    _, mean, _, _, model, max_iterations = inputs
    ctx.save_for_backward(mean, *model)
    ctx.max_iterations = max_iterations
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx: Any, grad_vertices: torch.Tensor, _iterations: None, _error: None) -> tuple[Any, ...]:
    mean, *model = ctx.saved_tensors
    grad_phi, grad_mean, grad_pins = torch.ops.warpgarment.poisson_solve_backward(
        grad_vertices, mean, model, ctx.max_iterations
    )
    return grad_phi, grad_mean, grad_pins, None, [None] * len(model), None


poisson_solve.register_autograd(_backward, setup_context=_setup)
