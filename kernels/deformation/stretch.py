"""Deformation gradients of known frames and their singular values in one launch, without gradients.

Φ = Q Q_rest⁻¹,   Σ its singular values, by the closed form of svd.py for such products
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .gradients import corners_exist, expect_mesh, face_frame
from .svd import frame_singular_values

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def stretch_kernel(
    from_row: wp.int32,
    # Model:
    inverse_rest: wp.array[wp.mat33],
    faces: wp.array[wp.vec3i],
    # In:
    vertices: wp.array[wp.vec3],
    # Out:
    phi: wp.array[wp.mat33],
    values: wp.array[wp.vec3],
):
    i = from_row + wp.tid()
    face = faces[i]
    if not corners_exist(face, vertices.shape[0]):
        phi[i] = wp.mat33(wp.nan)
        values[i] = wp.vec3(wp.nan)
        return
    q = face_frame(vertices[face[0]], vertices[face[1]], vertices[face[2]])
    phi[i] = q * inverse_rest[i]
    values[i] = frame_singular_values(q, inverse_rest[i])


def stretch(
    inverse_rest: torch.Tensor, vertices: torch.Tensor, faces: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Deformation gradients of faces and their singular values.

    Args:
        inverse_rest: Inverse rest frames from `inverse_rest_frames`, float32 [F, 3, 3].
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        Deformation gradients, float32 [F, 3, 3], and their singular values, descending, float32 [F, 3]; NaN for a face
        with an index out of range.
    """
    expect_mesh(vertices, faces)
    expect("inverse_rest", inverse_rest, (faces.shape[0], 3, 3), device=vertices.device)
    vertices, device = vertices.detach(), vertices.device
    phi = allocate((len(faces), 3, 3), torch.float32, device)
    values = allocate((len(faces), 3), torch.float32, device)
    with torch_stream(device) as warp_device:
        launch_rows(
            stretch_kernel,
            len(faces),
            [as_argument(inverse_rest, wp.mat33), as_argument(faces, wp.vec3i), as_argument(vertices, wp.vec3)],
            [as_argument(phi, wp.mat33), as_argument(values, wp.vec3)],
            warp_device,
            least=1024,
        )
    return phi, values
