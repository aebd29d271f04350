"""The kernels one by one, on the bundled dress remeshed to a number of faces, each against the published method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import igl
import numpy as np
import torch

from benchmarks.measure import Call, Row, aimed, aimed_time, compared, tensor
from benchmarks.scenes import Dressed, dressed
from warpgarment.kernels import deformation
from warpgarment.kernels.features.face import body_interaction, face_features
from warpgarment.kernels.features.frame import frame_features
from warpgarment.kernels.sdf.bodies import BodyMeshes

from . import exact, manifold, solves

SAMPLE = 256  # number of points whose distances are compared with brute force
LARGEST = 50_000  # largest number of faces for which the Poisson solve has a target


def all_rows(sizes: Sequence[int], large: bool, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows of all sizes, and with `large` the Poisson solve of 50,000 faces."""
    for faces in sizes:
        yield from rows(faces, device, seconds)
    if large:
        yield from solves.poisson(dressed(LARGEST), device, seconds)


def rows(faces: int, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows of all stages; `seconds` is spent on each call that is timed. References run on the CPU."""
    scene = dressed(faces)
    bodies = BodyMeshes(tensor(scene.body.vertices[0], device), tensor(scene.body.faces, device, np.int32))
    yield from _deformations(scene, device, seconds)
    yield from _distances(scene, bodies, device, seconds)
    yield from _features(scene, bodies, device, seconds)
    yield from solves.poisson(scene, device, seconds)
    yield from solves.collisions(scene, bodies, device, seconds)
    yield from manifold.heads(scene.garment, device, seconds)


def _deformations(scene: Dressed, device: torch.device, seconds: float) -> Iterator[Row]:
    garment, host, index = scene.garment, scene.first.astype(np.float64), scene.garment.faces.astype(np.int64)
    triangles, posed = tensor(garment.faces, device, np.int32), tensor(scene.first, device)
    inverse = deformation.inverse_rest_frames(tensor(garment.vertices, device), triangles)
    base = {"part": "stages", "faces": len(index)}

    def frames(v: np.ndarray) -> np.ndarray:
        a, b = v[index[:, 1]] - v[index[:, 0]], v[index[:, 2]] - v[index[:, 0]]
        n = np.cross(a, b)
        return np.stack([a, b, n / np.linalg.norm(n, axis=1, keepdims=True)], 2)

    def ours() -> torch.Tensor:
        return deformation.deformation_gradient_from_inverse(inverse, posed, triangles)

    rest = garment.vertices.astype(np.float64)
    yield from compared(
        base | {"what": "deformation gradients"},
        ours,
        {"NumPy": lambda: frames(host) @ np.linalg.inv(frames(rest))},
        device,
        seconds,
    )
    phi = ours()
    values, phi_host = deformation.singular_values(phi), phi.cpu().numpy().astype(np.float64)
    yield from compared(
        base | {"what": "replace singular values"},
        lambda: deformation.replace_singular_values(phi, values),
        {"NumPy SVD": lambda: np.linalg.svd(phi_host)},
        device,
        seconds,
    )


def _distances(scene: Dressed, bodies: BodyMeshes, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows on distances from face centroids, for the network, and from vertices, for the collisions."""
    triangles, posed = tensor(scene.garment.faces, device, np.int32), tensor(scene.first, device)
    centroids, body = deformation.face_centroids(posed, triangles), tensor(scene.body.vertices[0], device)
    body_host, body_faces = scene.body.vertices[0].astype(np.float64), scene.body.faces.astype(np.int64)
    points = centroids.cpu().numpy().astype(np.float64)
    base = {"part": "stages", "faces": len(triangles)}

    def libigl(p: np.ndarray) -> np.ndarray:
        sign = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        return np.asarray(igl.signed_distance(p, body_host, body_faces, sign_type=sign)[0])

    def ours() -> torch.Tensor:
        bodies.update(body)
        return bodies.query(centroids).distance

    chosen = np.linspace(0, len(points) - 1, min(SAMPLE, len(points))).astype(int)
    truth = exact.signed_distance(points[chosen], body_host, body_faces)
    error = 1e3 * float(np.abs(ours().cpu().numpy()[chosen] - truth).max())
    reference_error = 1e3 * float(np.abs(libigl(points)[chosen] - truth).max())
    base |= {"what": "signed distance, refit included", "error_mm": error, "reference_error_mm": reference_error}
    for row in compared(base, ours, {"libigl fast winding number": lambda: libigl(points)}, device, seconds):
        reached = f"{row['ratio']:.2f} x; {error:.1e} mm beside {reference_error:.1e} mm"
        better = row["ratio"] >= 1.5 and error <= reference_error
        yield aimed(row, "1.5 x faster than libigl, more exact", reached, better) if device.type == "cpu" else row

    base = {"part": "stages", "faces": len(triangles)}
    pressed, host = tensor(scene.pressed, device), scene.pressed.astype(np.float64)
    calls: dict[str, Call] = {
        "contact query, within 4 mm": lambda: bodies.query(pressed, within=0.004),
        "depth query, inside only": lambda: bodies.query(pressed, within=0.0),
    }
    yield from compared(
        base | {"what": "queries"}, calls, {"libigl fast winding number": lambda: libigl(host)}, device, seconds
    )
    triangles = tensor(scene.body.faces, device, np.int32)
    yield from compared(
        base | {"what": f"refit of the body, {len(triangles):,} faces"},
        lambda: bodies.update(body),
        {"building it anew": lambda: BodyMeshes(body, triangles)},
        device,
        seconds,
    )


def _features(scene: Dressed, bodies: BodyMeshes, device: torch.device, seconds: float) -> Iterator[Row]:
    garment, following = scene.garment, tensor(scene.body.vertices[1], device)
    triangles, posed = tensor(garment.faces, device, np.int32), tensor(scene.first, device)
    inverse = deformation.inverse_rest_frames(tensor(garment.vertices, device), triangles)
    centroids = deformation.face_centroids(posed, triangles)
    owner = torch.zeros(len(triangles), dtype=torch.int32, device=device)
    mean = centroids.mean(0, keepdim=True)
    base = {"part": "stages", "faces": len(triangles)}

    def queried():
        return body_interaction(centroids, None, bodies, following)

    interaction = queried()
    yield from compared(
        base | {"what": "features of a frame, one launch"},
        lambda: frame_features(inverse, posed, triangles, owner, mean, None, bodies, following),
        {"in two launches": lambda: face_features(inverse, posed, triangles, owner, mean, queried())},
        device,
        seconds,
    )
    for row in compared(
        base | {"what": "features other than distance"},
        lambda: face_features(inverse, posed, triangles, owner, mean, interaction),
        {},
        device,
        seconds,
    ):
        named = 4_000 < len(triangles) < 6_000 and device.type == "cpu"
        yield aimed_time(row, 1.0, 5_000) if named else row
