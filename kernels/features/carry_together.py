r"""Positions that garments over each other would have if all moved with the body by one smooth motion of space.

    V' = Σ_j w_j (D_j V + b_j + r_j) / Σ_j w_j,    w_j = (1 - |V - c_j|² / R²)² within R,    b_j = U_j + q̄_j - D_j U_j

Sample faces j of an outfit, one for each cell of a few centimetres, move with the body as in carry.py: U_j is the point
of the body nearest to the centroid c_j, D_j and q̄_j are its motion. A vertex takes the mean of their motions around it.
Cloth that hangs far from the body moves otherwise: r_j is what is missing at the sample from its predicted position,
once V' has been computed there without it.

Layers at one place therefore move alike, and where nothing crosses before, nothing crosses after, as long as the mean
varies little over a face. The motion of a single face of the body varies too much: of 78 recorded frames of outfits
whose layers do not touch, it makes 39 cross; the mean within 20 cm none. As R grows, the motion of an outfit becomes
affine, and then nothing can begin to cross.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, torch_stream
from warpgarment.kernels.operator import allocate

from .carry import DEFORMATION, DIRECTION, DISTANCE, VELOCITY, three
from .channels import FEATURES

wp.set_module_options(compiling.options())

REACH = 0.2
"""R [m]."""
OWN = wp.constant(1.0e-6)
"""Weight of no motion at all; it decides only where no sample is within reach."""


@wp.kernel(enable_backward=False)
def sample_motions(
    # Model:
    faces: wp.array[wp.vec3i],
    samples: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    features: wp.array2d[wp.float32],
    # Out:
    centre: wp.array[wp.vec3],
    linear: wp.array[wp.mat33],
    offset: wp.array[wp.vec3],
):
    j = wp.tid()
    f = samples[j]
    c = (vertices[faces[f][0]] + vertices[faces[f][1]] + vertices[faces[f][2]]) / 3.0
    point = c + wp.abs(features[f, DISTANCE]) * three(features, f, DIRECTION)
    d = wp.matrix_from_rows(
        three(features, f, DEFORMATION), three(features, f, DEFORMATION + 3), three(features, f, DEFORMATION + 6)
    )
    centre[j] = c
    linear[j] = d
    offset[j] = point + three(features, f, VELOCITY) - d * point


@wp.func
def blended(
    x: wp.vec3,
    first: int,
    last: int,
    reach: float,
    centre: wp.array[wp.vec3],
    linear: wp.array[wp.mat33],
    offset: wp.array[wp.vec3],
) -> wp.vec3:
    """The mean of the motions of samples around a point, applied to it [m]."""
    total = wp.float32(OWN)
    a = OWN * wp.identity(n=3, dtype=wp.float32)
    b = wp.vec3()
    for j in range(first, last):
        away = x - centre[j]
        near = 1.0 - wp.dot(away, away) / (reach * reach)
        if near > 0.0:
            w = near * near
            total += w
            a += w * linear[j]
            b += w * offset[j]
    return (a * x + b) / total


@wp.kernel(enable_backward=False)
def missing_motions(
    # Model:
    faces: wp.array[wp.vec3i],
    samples: wp.array[wp.int32],
    outfit_of_vertex: wp.array[wp.int32],
    sample_offsets: wp.array[wp.int32],
    reach: wp.float32,
    # In:
    predicted: wp.array[wp.vec3],
    centre: wp.array[wp.vec3],
    linear: wp.array[wp.mat33],
    offset: wp.array[wp.vec3],
    # Out:
    corrected: wp.array[wp.vec3],
):
    """b_j + r_j."""
    j = wp.tid()
    corner = faces[samples[j]]
    o = outfit_of_vertex[corner[0]]
    wanted = (predicted[corner[0]] + predicted[corner[1]] + predicted[corner[2]]) / 3.0
    moved = blended(centre[j], sample_offsets[o], sample_offsets[o + 1], reach, centre, linear, offset)
    corrected[j] = offset[j] + wanted - moved


@wp.kernel(enable_backward=False)
def blended_motion(
    # Model:
    outfit_of_vertex: wp.array[wp.int32],
    sample_offsets: wp.array[wp.int32],
    reach: wp.float32,
    # In:
    vertices: wp.array[wp.vec3],
    centre: wp.array[wp.vec3],
    linear: wp.array[wp.mat33],
    offset: wp.array[wp.vec3],
    # Out:
    carried: wp.array[wp.vec3],
):
    i = wp.tid()
    x = vertices[i]
    o = outfit_of_vertex[i]
    moved = x
    if o >= 0:
        moved = blended(x, sample_offsets[o], sample_offsets[o + 1], reach, centre, linear, offset)
    carried[i] = moved


def carried_together(
    vertices: torch.Tensor,
    predicted: torch.Tensor,
    faces: torch.Tensor,
    features: torch.Tensor,
    samples: torch.Tensor,
    outfit_of_vertex: torch.Tensor,
    sample_offsets: torch.Tensor,
    *,
    reach: float = REACH,
) -> torch.Tensor:
    """Moves vertices of frame t with the body to frame t+1, all garments of an outfit by one motion; no gradients.

    Args:
        vertices: Positions in frame t [m], float32 [V,3].
        predicted: Predicted positions in frame t+1 [m], float32 [V,3].
        faces: Vertex indices, int32 [F,3].
        features: Features of frame t, float32 [F,34].
        samples: Faces whose motion is used, those of each outfit one after another, int32 [S].
        outfit_of_vertex: Outfit of each vertex, int32 [V]; -1 for vertices that stay.
        sample_offsets: First sample of each outfit, and S, int32 [O+1].
        reach: R [m]. If it is infinite, each outfit moves by one affine motion, by which nothing can begin to cross.

    Returns:
        Positions [m], float32 [V,3].
    """
    device = vertices.device
    expect("vertices", vertices, (None, 3))
    expect("predicted", predicted, (len(vertices), 3), device=device)
    expect("faces", faces, (None, 3), torch.int32, device)
    expect("features", features, (len(faces), FEATURES), device=device)
    expect("samples", samples, (None,), torch.int32, device)
    expect("outfit_of_vertex", outfit_of_vertex, (len(vertices),), torch.int32, device)
    expect("sample_offsets", sample_offsets, (None,), torch.int32, device)
    centre, offset, corrected = allocate((3, len(samples), 3), torch.float32, device)
    linear = allocate((len(samples), 3, 3), torch.float32, device)
    carried = allocate(vertices.shape, torch.float32, device)
    points = as_argument(vertices.detach(), wp.vec3)
    owners = [as_argument(outfit_of_vertex, wp.int32), as_argument(sample_offsets, wp.int32), reach]
    motions = [as_argument(centre, wp.vec3), as_argument(linear, wp.mat33), as_argument(offset, wp.vec3)]
    with torch_stream(device) as warp_device:
        wp.launch(
            sample_motions,
            dim=len(samples),
            inputs=[
                as_argument(faces, wp.vec3i),
                as_argument(samples, wp.int32),
                points,
                as_argument(features.detach(), wp.float32),
            ],
            outputs=motions,
            device=warp_device,
        )
        wp.launch(
            missing_motions,
            dim=len(samples),
            inputs=[
                as_argument(faces, wp.vec3i),
                as_argument(samples, wp.int32),
                *owners,
                as_argument(predicted.detach(), wp.vec3),
                *motions,
            ],
            outputs=[as_argument(corrected, wp.vec3)],
            device=warp_device,
        )
        wp.launch(
            blended_motion,
            dim=len(vertices),
            inputs=[*owners, points, *motions[:2], as_argument(corrected, wp.vec3)],
            outputs=[as_argument(carried, wp.vec3)],
            device=warp_device,
        )
    return carried
