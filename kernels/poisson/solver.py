"""From deformation gradients back to vertices: the Poisson solve, once per frame and component.

Supplement section 1.3, eq. 1, its in-plane part (the part along the normal does not depend on positions):

    V* = argmin_V Σ_i s_i ‖(Φ_i(V) - Φ_i) P_i‖²,    P_i = I - n_i n_iᵀ of the rest triangle

With the half cotangents w of the rest mesh this is Σ over the edges (a, b) of every triangle of
w |(V_a - V_b) - Φ_i (X_a - X_b)|², so that V* solves L V = G(Φ). The solve is for the increment D from a guess V⁰,

    (L + W) D = g,    g_a = -Σ_edges w ((V⁰_a - V⁰_b) - Φ_i (X_a - X_b)) + W_a (t_a - V⁰_a)

whose right-hand side is a sum of differences, and therefore small and exact for a good guess. L does not determine the
translation of a component; it follows from the pins W, or without pins from `mean`, the wanted mean of face centroids.

| symbol | code | what |
| --- | --- | --- |
| Φ_i | `phi` | deformation gradient of face i, [3,3] |
| X | `rest_vertices` | rest positions [m] |
| V⁰, D | `initial`, `increment` | guess, and the unknown increment [m] |
| w | `half_cotangent` | ½ cot of the angle opposite to an edge |
| L | `laplacian.cotangent_laplacian` | [V,V] |
| W, t | `pin_stiffness, pin_target` | soft constraints: stiffness, and target [m] |
| z | `mean` | mean of the face centroids [m], one per component (section 4.2) |

The matrix is constant, so it is factored once (linear/factor.py) and every solve is direct (linear/triangular.py);
components without a factor are solved by conjugate gradients (linear/conjugate_gradients.py). The operator is linear
in (Φ, mean, t), and the gradient is the adjoint: one more solve with the same matrix.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import torch

from warpgarment.kernels.launch import expect
from warpgarment.kernels.linear import factor
from warpgarment.kernels.linear.progress import Progress
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.mesh.laplacian import as_numpy, components, cotangent_laplacian, half_cotangents
from warpgarment.kernels.operator import Packed, pack

from .kernels import FREE, ISOLATED, PINNED
from .operator import MODEL, Matrix, solved

TOLERANCE = 3e-7
"""Error of conjugate gradients in the energy norm as a share of the rest bounding box diagonal.

Measured on skirts, sheets with obtuse triangles and narrow strips of 280 to 9,600 faces, from near and far guesses:
the largest error of a vertex is 7e-5 of the diagonal at 1e-5, 1.4e-5 at 1e-6, and 2e-6 at 3e-7, which takes some 15 %
more iterations than 1e-5.
"""


class PoissonSolver:
    """Vertices whose deformation gradients are closest to given ones, for a packed batch of rest meshes.

    A batch is a union of connected components, and each of them is a system of its own.

    Args:
        rest_vertices: Rest positions [m], float32 [V,3], on the device of the solver.
        faces: Vertex indices, int32 [F,3].
        pins: Vertices held by soft constraints, integers [P], no vertex twice.
        pin_weight: Stiffness of a pin, in units of the mean diagonal entry of its component's Laplacian.
        tolerance: Error in the energy norm at which conjugate gradients stop, as a share of the diagonal of the
            component's rest bounding box. The default keeps every vertex within 1e-5 of that diagonal of the direct
            solution.
        max_iterations: Limit of conjugate gradients per solve; reaching it warns once.
        factor_budget: Limit of the entries of all factors together, 12 bytes each. Components whose factor does not
            fit are solved by conjugate gradients; with zero, all components are.
        explicit: Whether factors are inverted, so that all rows of a solution are computed at once; None means that
            they are inverted on a GPU only.

    Raises:
        ValueError: Shapes are wrong, indices are out of range, a pin is given twice, rest faces have no area, or
            options are not positive.
        TypeError: A dtype is wrong.
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
        factor_budget: int = factor.BUDGET,
        explicit: bool | None = None,
    ) -> None:
        expect("rest_vertices", rest_vertices, (None, 3))
        expect("faces", faces, (None, 3), torch.int32, rest_vertices.device)
        for name, option in (("pin_weight", pin_weight), ("tolerance", tolerance), ("max_iterations", max_iterations)):
            if not option > 0:
                raise ValueError(f"{name} must be positive, got {option}")
        if factor_budget < 0:
            raise ValueError(f"factor_budget must not be negative, got {factor_budget}")
        device, vertex_count = rest_vertices.device, len(rest_vertices)
        host_vertices = as_numpy("rest_vertices", rest_vertices, np.float64)
        host_faces = as_numpy("faces", faces, np.int32)
        pins = _host_pins(pins, vertex_count)

        cotangents = half_cotangents(host_vertices, host_faces)
        matrix = cotangent_laplacian(host_vertices, host_faces)
        vertex_component, face_component, count = components(vertex_count, host_faces)
        diagonal = matrix.diagonal()
        stiffness = np.zeros(vertex_count)
        for component in np.unique(vertex_component[pins]):  # each its own, so that a batch changes none of them
            of_component = vertex_component == component
            usual = diagonal[of_component & (diagonal > 0)]
            stiffness[pins[vertex_component[pins] == component]] = pin_weight * (usual.mean() if len(usual) else 1.0)
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
            "corner_edge": _corner_edges(host_vertices, host_faces, cotangents)[corners],
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
        matrix = (matrix + scipy.sparse.diags(stiffness)).tocsr()
        system = System.build(matrix, vertex_component, count, device)
        explicit = device.type != "cpu" if explicit is None else explicit
        grounded = (matrix + scipy.sparse.diags(_ground(matrix, vertex_component, kind))).tocsr()
        factors = factor.Factor.build(grounded, system, explicit=explicit, budget=factor_budget)
        self._model = Packed([*(tensors[name] for name, _ in MODEL), *pack(Matrix(system, factors))])
        self._progress = Progress("PoissonSolver")
        self.rest_vertices, self.faces = tensors["rest_vertices"], tensors["faces"]
        self.pins = tensors["pins"]
        self.vertex_component = tensors["vertex_component"]
        self.face_component = torch.from_numpy(face_component).to(device)
        self.component_count = count
        self.max_iterations = int(max_iterations)

    @property
    def iterations(self) -> int:
        """Conjugate gradient iterations of the last solve, the largest of all components; 0 if all were direct."""
        return self._progress.iterations

    def summary(self) -> torch.Tensor:
        """Report of the last solve: iterations, number of components stopped by the limit, their largest error [m].

        float64 [3] on the solver's device; does not wait for the solve.
        """
        return self._progress.summary()

    def warn_if_stopped(self, stopped: float, error: float) -> None:
        """Warns, once, if components were stopped by the limit.

        Args:
            stopped: Number of components that were stopped, from a `summary` that was read from the device.
            error: Largest error of those components [m], from that summary.
        """
        self._progress.warn_if_stopped(stopped, self.component_count, error)

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
            initial: Guess of the positions [m], float32 [V,3], or None for the rest positions. A closer guess makes
                the solve faster. The solution does not depend on it, except that vertices without faces or pin keep it.
            pin_targets: Positions to which the pins are drawn [m], float32 [P,3]; required if there are pins.

        Returns:
            Positions [m], float32 [V,3].

        Raises:
            ValueError: A shape or device is wrong, or pin_targets are missing.
            TypeError: A dtype is wrong.
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
        vertices, report, error = solved(phi, mean, pin_targets, initial.detach(), self._model, self.max_iterations)
        self._progress.record(report, error, self.max_iterations)
        return vertices


def _corner_edges(vertices: np.ndarray, faces: np.ndarray, cotangents: np.ndarray) -> np.ndarray:
    """Σ w (X_a - X_b) over the two edges at each corner a, [3F,3], which Φ multiplies in g."""
    corner, edges = vertices[faces], np.zeros((len(faces), 3, 3))
    for step in (1, 2):  # from corner k to k + step, opposite to k + 3 - step
        edges += np.roll(cotangents, step, axis=1)[:, :, None] * (corner - np.roll(corner, -step, axis=1))
    return edges.reshape(-1, 3)


def _ground(matrix: scipy.sparse.csr_matrix, vertex_component: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """A stiffness at the first vertex of each free component, which makes its matrix definite, float64 [V].

    The right-hand side of a free component sums to zero, so that the increment of the first vertex is zero and the
    other equations are unchanged.
    """
    largest = np.zeros(len(kind))
    np.maximum.at(largest, vertex_component, matrix.diagonal())
    ground = np.zeros(len(vertex_component))
    first = np.unique(vertex_component, return_index=True)[1]
    ground[first] = np.where(kind == FREE, largest, np.where(kind == ISOLATED, 1.0, 0.0))
    return ground


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
