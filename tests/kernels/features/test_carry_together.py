"""The motion that carries an outfit, beside its twin in float64."""

import numpy as np
import pytest
import torch
from support.layers import packed, tubes
from support.poison import poison_outputs

from tests.reference import cloth as reference
from warpgarment.kernels.features.carry_together import carried_together
from warpgarment.kernels.features.channels import FEATURES, LAYOUT


def scene(seed: int = 0):
    """Two outfits and a garment of none, with random features of a body that turns and stretches everywhere."""
    rng = np.random.default_rng(seed)
    vertices, outfits = packed(tubes(2), tubes(1), tubes(1))
    faces = outfits.faces.numpy()
    of_face = outfits.outfit.numpy()
    outfit_of_vertex = np.zeros(len(vertices), np.int32)
    outfit_of_vertex[faces] = np.where(of_face < 2, of_face, -1)[:, None]
    features = rng.normal(size=(len(faces), FEATURES)).astype(np.float32)
    features[:, LAYOUT["signed_distance"]] *= 0.02
    features[:, LAYOUT["direction_to_body"]] /= np.linalg.norm(features[:, LAYOUT["direction_to_body"]], axis=1)[
        :, None
    ]
    features[:, LAYOUT["body_deformation"]] = np.eye(3).ravel() + 0.1 * features[:, LAYOUT["body_deformation"]]
    features[:, LAYOUT["body_velocity"]] *= 0.01
    samples = np.concatenate([np.flatnonzero(of_face == k)[::5] for k in (0, 1)]).astype(np.int32)
    offsets = np.searchsorted(of_face[samples], [0, 1, 2]).astype(np.int32)
    predicted = (vertices + rng.normal(0, 0.01, vertices.shape)).astype(np.float32)
    return vertices, predicted, faces, features, samples, outfit_of_vertex, offsets


@pytest.mark.parametrize("reach", [0.1, 0.2, 1e6])
def test_carried_is_that_of_the_twin(monkeypatch, reach):
    """Layers would be carried to other places than the formula says. 1 um; garments of no outfit stay."""
    poison_outputs(monkeypatch)
    given = scene()
    vertices, predicted, faces, features, samples, outfit_of_vertex, offsets = given
    carried = carried_together(*map(torch.from_numpy, given), reach=reach).numpy()
    f = features[samples].astype(float)
    centre = vertices.astype(float)[faces[samples]].mean(1)
    point = centre + np.abs(f[:, LAYOUT["signed_distance"]]) * f[:, LAYOUT["direction_to_body"]]
    linear = f[:, LAYOUT["body_deformation"]].reshape(-1, 3, 3)
    offset = point + f[:, LAYOUT["body_velocity"]] - np.einsum("nij,nj->ni", linear, point)
    twin = reference.carried_together(
        vertices.astype(float),
        predicted.astype(float),
        faces,
        samples,
        outfit_of_vertex,
        offsets,
        (linear, offset),
        reach,
    )
    assert np.abs(carried - twin).max() < 1e-6
    assert (carried[outfit_of_vertex < 0] == vertices[outfit_of_vertex < 0]).all()
    assert np.abs(carried - vertices)[outfit_of_vertex >= 0].max() > 1e-3


def test_an_outfit_carried_everywhere_alike_moves_by_one_affine_motion():
    """The last resort would itself make faces cross. 1 um beside the affine map fitted to all vertices of an outfit."""
    given = scene(1)
    carried = carried_together(*map(torch.from_numpy, given), reach=1e6).numpy().astype(float)
    own = given[5] == 0
    ones = np.column_stack([given[0][own].astype(float), np.ones(own.sum())])
    fitted = ones @ np.linalg.lstsq(ones, carried[own], rcond=None)[0]
    assert np.abs(fitted - carried[own]).max() < 1e-6
