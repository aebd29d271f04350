"""From deformation gradients back to vertices: the Poisson solve, once per frame and component.

Supplement section 1.3, eq. 1, its in-plane part (the part along the normal says nothing about positions):

    V* = argmin_V Σ_i s_i ‖(Φ_i(V) - Φ_i) P_i‖²,    P_i = I - n_i n_iᵀ of the rest triangle

With the half cotangents w of the rest mesh this is Σ over the edges (a, b) of every triangle of
w |(V_a - V_b) - Φ_i (X_a - X_b)|², so that V* solves L V = G(Φ). The solve is for the increment D from a guess V⁰,

    (L + W) D = g,    g_a = -Σ_edges w ((V⁰_a - V⁰_b) - Φ_i (X_a - X_b)) + W_a (t_a - V⁰_a)

whose right-hand side is summed from differences and therefore small and exact when the guess is good. L leaves the
translation of a component free: it follows from the pins W, or else from `mean`, the wanted mean of the face centroids.

| symbol | code | what |
| --- | --- | --- |
| Φ_i | `phi` | deformation gradient of face i, [3,3] |
| X | `rest_vertices` | rest positions |
| V⁰, D | `initial`, `increment` | guess and what is solved for |
| w | `half_cotangent` | ½ cot of the angle opposite to an edge |
| L | `laplacian.cotangent_laplacian` | [V,V] |
| W, t | `pin_stiffness, pin_target` | soft constraints |
| z | `mean` | mean of the face centroids, one per component (section 4.2) |

The operator is linear in (Φ, mean, t), and the gradient is the adjoint: one more solve with the same matrix.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch
import warp as wp

from . import cg
from ._operator import allocate
from ._torch import expect, torch_stream
from .laplacian import as_numpy, components, cotangent_laplacian, half_cotangents

TOLERANCE = 3e-7
"""Error of a solve in the energy norm as a share of the rest bounding box diagonal.

Measured on skirts, sheets with obtuse triangles and narrow strips of 280 to 9,600 faces, from near and far guesses:
the worst vertex is off by up to 7e-5 of the diagonal at 1e-5, 1.4e-5 at 1e-6, and 2e-6 at 3e-7, for some 15 % more
iterations than at 1e-5.
"""
ADJOINT_TOLERANCE = 1e-6
"""Error of the adjoint solve in the energy norm as a share of the norm of its solution."""

FREE = wp.constant(0)  # translation from `mean`
PINNED = wp.constant(1)  # translation from the pins
ISOLATED = wp.constant(2)  # a vertex without faces or pin: stays where it is


@wp.func
def load(matrices: wp.array3d[wp.float32], i: int) -> wp.mat33d:
    m = wp.mat33d()
    for r in range(3):
        for c in range(3):
            m[r, c] = wp.float64(matrices[i, r, c])
    return m


@wp.func
def rest_edge(rest_vertices: wp.array[wp.vec3], a: int, b: int) -> wp.vec3d:
    return wp.vec3d(rest_vertices[a]) - wp.vec3d(rest_vertices[b])


@wp.kernel(enable_backward=False)
def right_hand_side(
    # Model:
    rest_vertices: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    half_cotangent: wp.array2d[wp.float64],
    corner_start: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    pin_of_vertex: wp.array[wp.int32],
    pin_stiffness: wp.array[wp.float64],
    # In:
    phi: wp.array3d[wp.float32],
    initial: wp.array[wp.vec3d],
    pin_target: wp.array[wp.vec3],
    # Out:
    rhs: wp.array[wp.vec3d],
):
    """g of the docstring above, gathered by each vertex from its corners, in a fixed order."""
    a = wp.tid()
    g = wp.vec3d()
    for e in range(corner_start[a], corner_start[a + 1]):
        corner = corners[e]
        i = corner // 3
        target = load(phi, i)
        for k in range(1, 3):
            b = faces[i, (corner + k) % 3]
            w = half_cotangent[i, (corner + 3 - k) % 3]  # opposite to the edge (a, b)
            g -= w * ((initial[a] - initial[b]) - target * rest_edge(rest_vertices, a, b))
    pin = pin_of_vertex[a]
    if pin >= 0:
        g += pin_stiffness[a] * (wp.vec3d(pin_target[pin]) - initial[a])
    rhs[a] = g


@wp.kernel(enable_backward=False)
def place(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    kind: wp.array[wp.int32],
    centroid_weight: wp.array[wp.float64],
    # In:
    initial: wp.array[wp.vec3d],
    increment: wp.array[wp.vec3d],
    mean: wp.array[wp.vec3],
    # Out:
    vertices: wp.array[wp.vec3],
):
    """Adds the increment and moves a free component to its mean."""
    component, lane = wp.tid()
    stride = wp.block_dim()
    shift = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        shift -= centroid_weight[i] * (initial[i] + increment[i])
        k += stride
    shift = wp.vec3d(cg.block_sum(shift[0]), cg.block_sum(shift[1]), cg.block_sum(shift[2]))
    shift += wp.vec3d(mean[component])
    if kind[component] != FREE:
        shift = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        vertices[i] = wp.vec3(initial[i] + increment[i] + shift)
        k += stride


@wp.kernel(enable_backward=False)
def place_adjoint(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    kind: wp.array[wp.int32],
    centroid_weight: wp.array[wp.float64],
    # In:
    grad_vertices: wp.array[wp.vec3],
    # Out:
    rhs: wp.array[wp.vec3d],
    grad_mean: wp.array[wp.vec3],
):
    """The transpose of `place`: what reaches the increment and the mean."""
    component, lane = wp.tid()
    stride = wp.block_dim()
    total = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        total += wp.vec3d(grad_vertices[rows[k]])
        k += stride
    total = wp.vec3d(cg.block_sum(total[0]), cg.block_sum(total[1]), cg.block_sum(total[2]))
    if kind[component] != FREE:
        total = wp.vec3d()
    k = start[component] + lane
    while k < start[component + 1]:
        i = rows[k]
        g = wp.vec3d(grad_vertices[i]) - centroid_weight[i] * total
        if kind[component] == ISOLATED:
            g = wp.vec3d()
        rhs[i] = g
        k += stride
    if lane == 0:
        grad_mean[component] = wp.vec3(total)


@wp.kernel(enable_backward=False)
def phi_adjoint(
    # Model:
    rest_vertices: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    half_cotangent: wp.array2d[wp.float64],
    # In:
    adjoint: wp.array[wp.vec3d],
    # Out:
    grad_phi: wp.array3d[wp.float32],
):
    """∂/∂Φ_i = Σ_edges w (λ_a - λ_b)(X_a - X_b)ᵀ, λ the adjoint solution."""
    i = wp.tid()
    g = wp.mat33d()
    for k in range(3):
        a = faces[i, (k + 1) % 3]
        b = faces[i, (k + 2) % 3]
        g += half_cotangent[i, k] * wp.outer(adjoint[a] - adjoint[b], rest_edge(rest_vertices, a, b))
    for r in range(3):
        for c in range(3):
            grad_phi[i, r, c] = wp.float32(g[r, c])


# The tensors of a solver travel through the operators as one list, in this order; cg.System follows.
_MODEL = (
    ("rest_vertices", wp.vec3),
    ("faces", wp.int32),
    ("half_cotangent", wp.float64),
    ("corner_start", wp.int32),
    ("corners", wp.int32),
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
_SYSTEM = len(_MODEL)


def _views(model: list[torch.Tensor]) -> dict[str, object]:
    names = zip(_MODEL, model[:_SYSTEM], strict=True)
    return {name: cg.view(tensor, dtype) for (name, dtype), tensor in names if dtype is not None}


def _start_rows(model: list[torch.Tensor]) -> list[object]:
    return [cg.view(tensor, wp.int32) for tensor in model[_SYSTEM : _SYSTEM + 2]]


def _named(model: list[torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor for (name, _), tensor in zip(_MODEL, model[:_SYSTEM], strict=True)}


@torch.library.custom_op("warpgarment::poisson_solve", mutates_args=())
def poisson_solve(
    phi: torch.Tensor,
    mean: torch.Tensor,
    pin_target: torch.Tensor,
    initial: torch.Tensor,
    model: list[torch.Tensor],
    max_iterations: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The solve on tensors alone; see `PoissonSolver.solve`. Returns vertices, iterations and error per component."""
    tensors, m, count = _named(model), _views(model), len(mean)
    phi, mean, pin_target = phi.contiguous(), mean.contiguous(), pin_target.contiguous()
    guess = initial.to(torch.float64, copy=True, memory_format=torch.contiguous_format)
    if len(pin_target):  # the translation of a pinned component that its pins agree on
        pins = tensors["pins"]
        offset = torch.zeros((count, 3), dtype=torch.float64, device=phi.device)
        offset.index_add_(0, tensors["vertex_component"][pins], pin_target.double() - guess[pins])
        guess += (offset / tensors["pins_in_component"].clamp(min=1.0))[tensors["vertex_component"]]
    rhs = allocate(guess.shape, torch.float64, phi.device)
    vertices = allocate(guess.shape, torch.float32, phi.device)
    if count == 0:
        return vertices, vertices.new_empty(0, dtype=torch.int32), vertices.new_empty(0, dtype=torch.float64)
    with torch_stream(phi.device) as device:
        wp.launch(
            right_hand_side,
            dim=len(guess),
            inputs=[
                m["rest_vertices"],
                m["faces"],
                m["half_cotangent"],
                m["corner_start"],
                m["corners"],
                m["pin_of_vertex"],
                m["pin_stiffness"],
                cg.view(phi, wp.float32),
                cg.view(guess, wp.vec3d),
                cg.view(pin_target, wp.vec3),
                cg.view(rhs, wp.vec3d),
            ],
            device=device,
        )
        system, normal, tolerance = model[_SYSTEM:], tensors["no_normal"], tensors["tolerance"]
        increment, report, error = cg.solve(system, normal, rhs, tolerance, 0.0, max_iterations)
        wp.launch_tiled(
            place,
            dim=[count],
            inputs=[
                *_start_rows(model),
                m["kind"],
                m["centroid_weight"],
                cg.view(guess, wp.vec3d),
                cg.view(increment, wp.vec3d),
                cg.view(mean, wp.vec3),
                cg.view(vertices, wp.vec3),
            ],
            block_dim=cg.block_dim(phi.device, len(guess), count),
            device=device,
        )
    return vertices, report, error


@poisson_solve.register_fake
def _(phi, mean, pin_target, initial, model, max_iterations):
    count = mean.shape[0]
    return (
        torch.empty_like(initial, memory_format=torch.contiguous_format),
        mean.new_empty(count, dtype=torch.int32),
        mean.new_empty(count, dtype=torch.float64),
    )


@torch.library.custom_op("warpgarment::poisson_solve_backward", mutates_args=())
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
        wp.launch_tiled(
            place_adjoint,
            dim=[count],
            inputs=[
                *_start_rows(model),
                m["kind"],
                m["centroid_weight"],
                cg.view(grad_vertices, wp.vec3),
                cg.view(rhs, wp.vec3d),
                cg.view(grad_mean, wp.vec3),
            ],
            block_dim=cg.block_dim(mean.device, len(rhs), count),
            device=device,
        )
        system, nothing = model[_SYSTEM:], torch.zeros_like(tensors["tolerance"])
        adjoint, _, _ = cg.solve(system, tensors["no_normal"], rhs, nothing, ADJOINT_TOLERANCE, max_iterations)
        wp.launch(
            phi_adjoint,
            dim=len(grad_phi),
            inputs=[
                m["rest_vertices"],
                m["faces"],
                m["half_cotangent"],
                cg.view(adjoint, wp.vec3d),
                cg.view(grad_phi, wp.float32),
            ],
            device=device,
        )
    pins = tensors["pins"]
    grad_pins = (tensors["pin_stiffness"][pins, None] * adjoint[pins]).to(torch.float32)
    return grad_phi, grad_mean, grad_pins


@poisson_solve_backward.register_fake
def _(grad_vertices, mean, model, max_iterations):
    tensors = _named(model)
    return (
        mean.new_empty((tensors["faces"].shape[0], 3, 3)),
        torch.empty_like(mean, memory_format=torch.contiguous_format),
        mean.new_empty((tensors["pins"].shape[0], 3)),
    )


def _setup(ctx, inputs, output):
    _, mean, _, _, model, max_iterations = inputs
    ctx.save_for_backward(mean, *model)
    ctx.max_iterations = max_iterations
    ctx.mark_non_differentiable(*output[1:])


def _backward(ctx, grad_vertices, _iterations, _error):
    mean, *model = ctx.saved_tensors
    grad_phi, grad_mean, grad_pins = torch.ops.warpgarment.poisson_solve_backward(
        grad_vertices, mean, model, ctx.max_iterations
    )
    return grad_phi, grad_mean, grad_pins, None, [None] * len(model), None


poisson_solve.register_autograd(_backward, setup_context=_setup)


class PoissonSolver:
    """Vertices whose deformation gradients are closest to given ones, for a packed batch of rest meshes.

    A batch is a union of connected components, and each of them is a system of its own.

    Args:
        rest_vertices: Rest positions [m], float32 [V,3]; their device is the solver's.
        faces: Vertex indices, int32 [F,3].
        pins: Vertices held by soft constraints, integers [P], no vertex twice.
        pin_weight: Stiffness of a pin, in units of the mean diagonal entry of the Laplacian.
        tolerance: Where the iteration stops: error in the energy norm as a share of the component's rest bounding box
            diagonal. The default keeps every vertex within 1e-5 of that diagonal of the direct solution.
        max_iterations: Limit per solve; reaching it warns once.

    Raises:
        ValueError: Wrong shapes, indices out of range, a pin twice, rest faces without area, options not positive.
        TypeError: Wrong dtypes.
    """

    def __init__(
        self,
        rest_vertices: torch.Tensor,
        faces: torch.Tensor,
        *,
        pins: torch.Tensor | np.ndarray | None = None,
        pin_weight: float = 10.0,
        tolerance: float = TOLERANCE,
        max_iterations: int = 5000,
    ) -> None:
        expect("rest_vertices", rest_vertices, (None, 3))
        expect("faces", faces, (None, 3), torch.int32, rest_vertices.device)
        for name, option in (("pin_weight", pin_weight), ("tolerance", tolerance), ("max_iterations", max_iterations)):
            if not option > 0:
                raise ValueError(f"{name} must be positive, got {option}")
        device, vertex_count = rest_vertices.device, len(rest_vertices)
        host_vertices = as_numpy("rest_vertices", rest_vertices, np.float64)
        host_faces = as_numpy("faces", faces, np.int32)
        pins = _host_pins(pins, vertex_count)

        cotangents = half_cotangents(host_vertices, host_faces)
        matrix = cotangent_laplacian(host_vertices, host_faces)
        vertex_component, face_component, count = components(vertex_count, host_faces)
        diagonal = matrix.diagonal()
        stiffness = np.zeros(vertex_count)
        stiffness[pins] = pin_weight * (diagonal[diagonal > 0].mean() if len(host_faces) else 1.0)
        pin_of_vertex = np.full(vertex_count, -1, np.int32)
        pin_of_vertex[pins] = np.arange(len(pins), dtype=np.int32)
        pins_in_component = np.bincount(vertex_component[pins], minlength=count).astype(np.float64)
        faces_in_component = np.bincount(face_component, minlength=count)
        kind = np.where(pins_in_component > 0, int(PINNED), np.where(faces_in_component > 0, int(FREE), int(ISOLATED)))
        uses = np.bincount(host_faces.ravel(), minlength=vertex_count)
        corners = np.argsort(host_faces.ravel(), kind="stable").astype(np.int32)
        low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
        np.minimum.at(low, vertex_component, host_vertices)
        np.maximum.at(high, vertex_component, host_vertices)

        host = {
            "half_cotangent": cotangents,
            "corner_start": np.concatenate([[0], np.cumsum(uses)]).astype(np.int32),
            "corners": corners,
            "pin_of_vertex": pin_of_vertex,
            "pin_stiffness": stiffness,
            "pins": pins,
            "vertex_component": vertex_component,
            "pins_in_component": pins_in_component[:, None],
            "kind": kind.astype(np.int32),
            "centroid_weight": uses / (3.0 * np.maximum(faces_in_component[vertex_component], 1)),
            "no_normal": np.zeros((vertex_count, 3)),
            "tolerance": tolerance * np.linalg.norm(high - low, axis=1),
        }
        tensors = {name: torch.from_numpy(np.ascontiguousarray(array)).to(device) for name, array in host.items()}
        tensors["rest_vertices"] = rest_vertices.detach().clone(memory_format=torch.contiguous_format)
        tensors["faces"] = faces.detach().clone(memory_format=torch.contiguous_format)
        system = cg.System.build(matrix + scipy.sparse.diags(stiffness), vertex_component, count, device)
        self._model = [*(tensors[name] for name, _ in _MODEL), *system]
        self._progress = cg.Progress("PoissonSolver")
        self.rest_vertices, self.faces = tensors["rest_vertices"], tensors["faces"]
        self.pins = tensors["pins"]
        self.vertex_component = tensors["vertex_component"]
        self.face_component = torch.from_numpy(face_component).to(device)
        self.component_count = count
        self.max_iterations = int(max_iterations)

    @property
    def iterations(self) -> int:
        """Iterations of the last solve, the largest of all components."""
        return self._progress.iterations

    def summary(self) -> torch.Tensor:
        """What the last solve says: iterations, components stopped by the limit, their largest error; not read."""
        return self._progress.summary()

    def tell(self, stopped: float, error: float) -> None:
        """Warns, once, if a summary that was read from the device says that components were stopped."""
        self._progress.tell(stopped, self.component_count, error)

    def solve(
        self,
        phi: torch.Tensor,
        mean: torch.Tensor,
        *,
        initial: torch.Tensor | None = None,
        pin_targets: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Solves eq. 1 of supplement section 1.3. Differentiable in `phi`, `mean` and `pin_targets`.

        Args:
            phi: Deformation gradients with respect to the rest mesh, float32 [F,3,3].
            mean: Wanted mean of the face centroids of each component [m], float32 [C,3]; not read for a component
                with pins or a vertex without faces.
            initial: A guess [m], the closer the faster, float32 [V,3]; the rest positions when None. The solution does
                not depend on it, except that vertices without faces or pin keep it.
            pin_targets: Where the pins are drawn to [m], float32 [P,3]; required when there are pins.

        Returns:
            Positions [m], float32 [V,3].

        Raises:
            ValueError: Wrong shape or device, or pin_targets missing.
            TypeError: Wrong dtype.
        """
        device = self.rest_vertices.device
        expect("phi", phi, (len(self.faces), 3, 3), device=device)
        expect("mean", mean, (self.component_count, 3), device=device)
        if initial is None:
            initial = self.rest_vertices
        expect("initial", initial, (len(self.rest_vertices), 3), device=device)
        if pin_targets is None:
            if len(self.pins):
                raise ValueError(f"the solver has {len(self.pins)} pins; pass pin_targets [{len(self.pins)}, 3]")
            pin_targets = mean.new_empty((0, 3))
        expect("pin_targets", pin_targets, (len(self.pins), 3), device=device)
        vertices, report, error = torch.ops.warpgarment.poisson_solve(
            phi, mean, pin_targets, initial.detach(), self._model, self.max_iterations
        )
        self._progress.record(report, error, self.max_iterations)
        return vertices


def _host_pins(pins: torch.Tensor | np.ndarray | None, vertex_count: int) -> np.ndarray:
    """Pins as int64 [P] on the host, checked."""
    host = np.zeros(0, np.int64) if pins is None else np.asarray(pins.cpu() if isinstance(pins, torch.Tensor) else pins)
    if host.ndim != 1:
        raise ValueError(f"pins must have shape [*], got {list(host.shape)}")
    if len(host) and host.dtype.kind not in "iu":
        raise TypeError(f"pins must be integers, got {host.dtype}")
    host = host.astype(np.int64)
    if len(host) and (host.min() < 0 or host.max() >= vertex_count):
        raise ValueError(f"pins hold indices {host.min()} to {host.max()}, there are {vertex_count} vertices")
    unique, uses = np.unique(host, return_counts=True)
    if len(unique) < len(host):
        raise ValueError(f"{int((uses > 1).sum())} pins occur more than once (first: vertex {unique[uses > 1][0]})")
    return host
