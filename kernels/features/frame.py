"""Features of a face and its interaction with the body in one launch, as a rollout computes them: see face.py.

The result is that of `body_interaction` and `face_features`. Those are for training and gradients, and a rollout does
not launch them: apart from them, this launch compiles in half of the time.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels.deformation.gradients import expect_mesh
from warpgarment.kernels.launch import as_argument, expect, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.closest import SEARCHES
from warpgarment.kernels.sdf.model import Bodies

from .channels import FEATURES
from .face import face_and_mean, nearest_motion, write_features


@wp.kernel(enable_backward=False, module=SEARCHES)
def frame_features_kernel(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
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
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    exist, a, b, c, mean = face_and_mean(i, faces, garment_of_face, vertices, garment_mean, features)
    if not exist:
        return
    closest, sign, _face, deformation, velocity = nearest_motion(
        bodies, body_of_face[i], (a + b + c) / 3.0, next_vertices
    )
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
    """Features of one frame, not normalised, with the interaction: in one launch and without gradients.

    Args:
        inverse_rest, vertices, faces, garment_of_face, garment_mean: Arguments of `face_features`.
        body_of_face, bodies, next_vertices: Arguments of `body_interaction`.

    Returns:
        Features, float32 [F, 34]; columns as in `LAYOUT` (channels.py).
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
            launch_rows(
                frame_features_kernel,
                rows,
                inputs=[
                    bodies.argument,
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
