"""Energies of cloth and their gradients against float64 twins, and what is known of them by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.physics import energies as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.physics import PhysicsCloth, Sheet
from warpgarment.kernels.physics.energies import cloth_energies

SHEET = Sheet.isotropic(0.3, 700.0, 400.0, 2e-3)
WOVEN = Sheet(0.2, np.array([[900.0, 120.0, 30.0], [120.0, 300.0, -10.0], [30.0, -10.0, 200.0]]), 1e-3)
GARMENTS = meshes.garments()


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def cloth_of(*parts: tuple[meshes.Mesh, Sheet], axes=None) -> PhysicsCloth:
    """Garments as the groups of one batch."""
    packed, starts = meshes.joined(*(mesh for mesh, _ in parts)), meshes.offsets(*(mesh for mesh, _ in parts))[0]
    owner = np.repeat(np.arange(len(parts)), [len(mesh.faces) for mesh, _ in parts])
    return PhysicsCloth.build(packed.vertices, packed.faces, starts, [sheet for _, sheet in parts], owner, axes=axes)


def energies(vertices: np.ndarray, cloth: PhysicsCloth) -> tuple[np.ndarray, np.ndarray]:
    """Membrane and bending energy of each group [J]."""
    return tuple(e.numpy() for e in cloth_energies(torch.from_numpy(vertices.astype(np.float64)), cloth))


@pytest.mark.parametrize("sheet", [SHEET, WOVEN], ids=["isotropic", "orthotropic"])
@pytest.mark.parametrize("name", GARMENTS)
def test_energies_agree_with_float64(name, sheet):
    """Cloth would be too stiff or too soft, or stiff along the wrong thread."""
    rest = GARMENTS[name]
    axes = np.broadcast_to(np.array([0.2, 1.0, 0.3]), (len(rest.faces), 3))
    cloth, moved = cloth_of((rest, sheet), axes=axes), meshes.moved(rest, 3).vertices.astype(np.float64)
    membrane, bending = energies(moved, cloth)
    points = rest.vertices.astype(np.float64)
    # sums of a thousand terms in float64; angles lose digits near zero, where the twin takes an arc cosine
    assert membrane[0] == pytest.approx(
        reference.membrane_energy(moved, rest.faces, points, sheet.stiffness, axes), rel=1e-9
    )
    assert bending[0] == pytest.approx(reference.bending_energy(moved, rest.faces, points, sheet.bend), rel=1e-5)


@pytest.mark.parametrize("part", [0, 1], ids=["membrane", "bending"])
def test_gradients_are_those_of_the_energies(part):
    """A step would go uphill: the gradient of each energy against central differences along random directions."""
    rest = GARMENTS[next(iter(GARMENTS))]
    cloth, moved = cloth_of((rest, WOVEN)), torch.from_numpy(meshes.moved(rest, 1).vertices.astype(np.float64))
    moved.requires_grad_()
    (gradient,) = torch.autograd.grad(cloth_energies(moved, cloth)[part].sum(), moved)
    rng = np.random.default_rng(0)
    for _ in range(5):
        way = torch.from_numpy(rng.normal(size=moved.shape))
        step = 1e-7
        ahead, behind = (cloth_energies(moved.detach() + s * step * way, cloth)[part].sum() for s in (1, -1))
        # the second difference of the energy over 1e-7 m, and rounding of 1e-16 of it over the same
        assert float((ahead - behind) / (2 * step)) == pytest.approx(float((gradient * way).sum()), rel=2e-6)


def test_groups_weigh_their_gradients():
    """In a batch, the loss of one garment would pull at another."""
    parts = [(GARMENTS[name], sheet) for name, sheet in zip(list(GARMENTS)[:2], (SHEET, WOVEN), strict=True)]
    cloth = cloth_of(*parts)
    moved = [meshes.moved(mesh, 4).vertices.astype(np.float64) for mesh, _ in parts]
    packed = torch.from_numpy(np.concatenate(moved)).requires_grad_()
    weights = torch.tensor([2.0, -0.5], dtype=torch.float64)
    found = cloth_energies(packed, cloth)
    (gradient,) = torch.autograd.grad((found.membrane * weights + found.bending * weights.flip(0)).sum(), packed)
    expected = []
    for number, (part, points) in enumerate(zip(parts, moved, strict=True)):
        alone = torch.from_numpy(points).requires_grad_()
        one = cloth_energies(alone, cloth_of(part))
        total = one.membrane[0] * weights[number] + one.bending[0] * weights[1 - number]
        expected.append(torch.autograd.grad(total, alone)[0])
        assert found.membrane[number].item() == pytest.approx(one.membrane[0].item(), rel=1e-12)
    torch.testing.assert_close(gradient, torch.cat(expected), rtol=1e-10, atol=1e-12)


def test_a_stretched_strip_by_hand():
    """Stiffness would not be in N/m: a square metre stretched by 10 % along the warp, held across."""
    rest = meshes.Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )
    axes = np.tile([1.0, 0.0, 0.0], (2, 1))
    membrane, bending = energies(rest.vertices * [1.1, 1.0, 1.0], cloth_of((rest, WOVEN), axes=axes))
    green = (1.1**2 - 1) / 2
    assert membrane[0] == pytest.approx(0.5 * 900.0 * green**2, rel=1e-6)  # the float32 of 1.1
    assert bending[0] == pytest.approx(0.0, abs=1e-20)


@pytest.mark.parametrize("angle", [-3.0, -1.0, 0.0, 2.0, 3.1])
def test_a_folded_edge_by_hand(angle):
    """Bending would not be a moment per angle and length: one edge of 0.7 m folded by an angle of either sign."""
    rest = meshes.Mesh(
        np.array([[0, 0, 0], [0.7, 0, 0], [0.2, 0.5, 0], [0.3, -0.4, 0]], np.float32),
        np.array([[0, 1, 2], [1, 0, 3]], np.int32),
    )
    folded = rest.vertices.astype(np.float64)
    folded[3] = [0.3, -0.4 * np.cos(angle), -0.4 * np.sin(angle)]
    membrane, bending = energies(folded, cloth_of((rest, SHEET)))
    assert bending[0] == pytest.approx(0.5 * 2e-3 * 0.7 * angle**2, rel=1e-6)
    assert membrane[0] == pytest.approx(0.0, abs=1e-10)  # float32 rest positions


def test_energies_do_not_depend_on_where_and_how_cloth_is_turned():
    """Cloth would be pulled towards an axis of the world."""
    rest = GARMENTS[next(iter(GARMENTS))]
    cloth, moved = cloth_of((rest, WOVEN)), meshes.moved(rest, 2).vertices.astype(np.float64)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    for one, other in zip(energies(moved, cloth), energies(moved @ turn.T + [3.0, -2.0, 1.0], cloth), strict=True):
        assert one[0] == pytest.approx(other[0], rel=1e-8)  # rounding at metres from the origin


def test_faces_without_area_are_named():
    """A garment with a sliver would become NaN in the first frame."""
    rest = meshes.Mesh(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(ValueError, match="1 of 1 rest faces have no area"):
        cloth_of((rest, SHEET))


def test_the_operator_is_a_torch_operator():
    """`torch.compile` would refuse a loss, or its gradient would not be registered."""
    rest = GARMENTS[next(iter(GARMENTS))]
    cloth = cloth_of((rest, SHEET))
    names = ("faces", "inverse_rest", "stiffness", "hinges", "rest_angle", "bend", "vertex_start")
    model = [getattr(cloth, name) for name in names]
    vertices = torch.from_numpy(rest.vertices.astype(np.float64)).requires_grad_()
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.warpgarment.cloth_energies, (vertices, model), test_utils=tests)
