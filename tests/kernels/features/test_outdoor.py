"""Channels of the material of a face and of the wind relative to it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from reference.finite_differences import numeric_gradient
from reference.outdoor import outdoor
from support.scenes import outfit, skirt

from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.kernels.features.outdoor import needs, packed_columns
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedGarments

CLOTH = [Material(density=0.08, stretch=400.0, shear=700.0, bend=2e-5, friction=0.1), None, Material(bend=0.0)]
FPS = 30.0


def batch(dtype=torch.float64):
    """Three garments that move, each with its own material and air, and the arguments for them."""
    garments, rng = [skirt(), outfit(), skirt()], np.random.default_rng(0)
    packed = PackedGarments.pack(garments, torch.device("cpu"))
    now = packed.rest_vertices.to(dtype)
    before = now + torch.from_numpy(rng.normal(scale=0.02, size=now.shape)).to(dtype)
    air = torch.from_numpy(rng.normal(scale=4.0, size=(3, 3))).to(dtype)
    fields = (np.nan,) * len(dataclasses.fields(Material))
    rows = [fields if cloth is None else dataclasses.astuple(cloth) for cloth in CLOTH]
    return packed, now, before, torch.tensor(rows, dtype=dtype), air


@pytest.mark.parametrize("names", [OUTDOOR.names, ("wind", "bend"), ("friction",)])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_channels_are_those_of_the_twin(names, dtype, tolerance):
    """A network would read another channel, another garment's material or air, or a wind that is not relative to the
    face. 2e-5 in float32: positions of a metre, 6e-8 off, times 30 frames a second; numbers up to 10."""
    packed, now, before, materials, air = batch(dtype)
    layout = OUTDOOR.only(names)
    found = packed_columns(layout, FPS, now, before, packed.faces, packed.garment_of_face, materials, air).double()
    assert found.shape == (len(packed.faces), layout.width)
    for g, cloth in enumerate(CLOTH):
        own = slice(packed.face_offsets[g], packed.face_offsets[g + 1])
        faces = packed.faces[own].numpy()
        expected = outdoor(names, now.double().numpy(), before.double().numpy(), faces, cloth, air[g].numpy(), FPS)
        np.testing.assert_allclose(found[own].numpy(), expected, rtol=0.0, atol=tolerance)


def test_air_and_material_that_are_not_given():
    """Still air would not be felt by cloth that moves, or a garment without a material would have one. Exact."""
    packed, now, before, _, _ = batch()
    on = packed.faces, packed.garment_of_face
    calm = packed_columns(OUTDOOR, FPS, now, before, *on, None, torch.zeros(3, 3, dtype=now.dtype))
    found = packed_columns(OUTDOOR, FPS, now, before, *on, None, None)
    assert torch.equal(found[:, 5:], calm[:, 5:])
    assert (found[:, 5:].norm(dim=1) > 0.05).all()  # minus the velocity of the face
    assert found[:, :5].isnan().all()
    assert not packed_columns(OUTDOOR, FPS, now, None, *on, None, None)[:, 5:].any()
    assert packed_columns(OUTDOOR.only(()), FPS, now, before, *on, None, None) is None


def test_gradient_of_the_relative_wind():
    """Unrolled training would not feel that its own steps change the wind on the cloth. 1e-6 of the largest entry:
    the channel is linear, so that differences in float64 are exact but for rounding."""
    packed, now, before, materials, air = batch()
    weight = torch.from_numpy(np.random.default_rng(1).normal(size=(len(packed.faces), 3)))
    on = packed.faces, packed.garment_of_face, materials, air

    def value(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (packed_columns(OUTDOOR, FPS, x, y, *on)[:, 5:] * weight).sum()

    some = slice(0, 6)  # vertices of the first garment
    for place in (0, 1):
        given = [now.clone(), before.clone()]
        given[place].requires_grad_(True)
        found = torch.autograd.grad(value(*given), given[place])[0][some].numpy()

        def moved(x: np.ndarray, place: int = place) -> float:
            changed = [now.clone(), before.clone()]
            changed[place][some] = torch.from_numpy(x)
            return value(*changed).item()

        expected = numeric_gradient(moved, (now, before)[place][some].numpy(), 1e-3)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())


def test_what_channels_need():
    """A simulation would not keep the frame before, or refuse a wind that the network reads."""
    assert needs(()) == frozenset()
    assert needs(("bend",)) == {"materials"}
    assert needs(("wind",)) == {"previous", "wind"}
    assert needs(OUTDOOR.names) == {"materials", "previous", "wind"}
