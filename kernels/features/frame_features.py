"""The network's input for one frame of a simulation, in one launch for all faces of all garments on all bodies.

Manifold-aware transformers, section 4.2: closest point, side, motion of the nearest body face and the 34 numbers of
face.py, bit by bit what `body_interaction` and `face_features` give.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels.deformation.gradients import corners_exist, expect_mesh
from warpgarment.kernels.launch import as_argument, expect, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.closest import Bodies

from .face import FEATURES, nearest_motion, write_features


@wp.kernel(enable_backward=False)
def frame_features_kernel(
    # Model:
    bodies: Bodies,
    inverse_rest: wp.array[wp.mat33],
    faces: wp.array[wp.vec3i],
    garment_of_face: wp.array[wp.int32],
    body_of_face: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    garment_mean: wp.array[wp.vec3],
    next_vertices: wp.array[wp.vec3],
    # Out:
    features: wp.array2d[wp.float32],
):
    i = wp.tid()
    face = faces[i]
    garment = garment_of_face[i]
    if not corners_exist(face, vertices.shape[0]) or garment < 0 or garment >= garment_mean.shape[0]:
        for k in range(wp.static(FEATURES)):
            features[i, k] = wp.nan
        return
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    closest, sign, _face, deformation, velocity = nearest_motion(
        bodies, body_of_face[i], (a + b + c) / 3.0, next_vertices
    )
    mean = garment_mean[garment]
    write_features(features, i, a, b, c, inverse_rest[i], mean, closest, sign, deformation, velocity)


def frame_features(
    inverse_rest: torch.Tensor,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    garment_of_face: torch.Tensor,
    garment_mean: torch.Tensor,
    body_of_face: torch.Tensor | None,
    bodies: BodyMeshes,
    next_vertices: torch.Tensor,
) -> torch.Tensor:
    """`face_features` with the `body_interaction` of the faces' centroids, in one launch and without gradients.

    Args:
        inverse_rest, vertices, faces, garment_of_face, garment_mean: As in `face_features`.
        body_of_face, bodies, next_vertices: As in `body_interaction`.

    Returns:
        float32 [F, 34]; columns as in `LAYOUT`.
    """
    expect_mesh(vertices, faces)
    rows, device = faces.shape[0], bodies.device
    expect("vertices", vertices, (None, 3), device=device)
    expect("inverse_rest", inverse_rest, (rows, 3, 3), device=device)
    expect("garment_of_face", garment_of_face, (rows,), torch.int32, device)
    expect("garment_mean", garment_mean, (None, 3), device=device)
    expect("next_vertices", next_vertices, tuple(bodies.vertices.shape), device=device)
    body_of_face = bodies.body_of("body_of_face", body_of_face, rows)
    features = allocate((rows, FEATURES), torch.float32, device)
    if rows:
        with torch_stream(device) as warp_device:
            wp.launch(
                frame_features_kernel,
                dim=rows,
                inputs=[
                    bodies.model,
                    as_argument(inverse_rest, wp.mat33),
                    as_argument(faces, wp.vec3i),
                    as_argument(garment_of_face, wp.int32),
                    as_argument(body_of_face, wp.int32),
                    as_argument(vertices, wp.vec3),
                    as_argument(garment_mean, wp.vec3),
                    as_argument(next_vertices, wp.vec3),
                ],
                outputs=[as_argument(features, wp.float32)],
                device=warp_device,
            )
    return features
