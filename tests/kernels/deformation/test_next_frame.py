"""Singular values without LAPACK, the gradients a garment should have next, and its means, against float64 NumPy."""

import numpy as np
import pytest
import torch
from reference import deformation as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import deformation
from warpgarment.kernels.deformation.face_means import FaceMeans
from warpgarment.kernels.deformation.next_frame import keep_finite, next_gradients


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def rotations(count: int, rng: np.random.Generator) -> np.ndarray:
    """Random proper rotations, float64."""
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


HARD = {
    "cloth": [1.05, 1.0, 0.97],
    "all equal": [1.0, 1.0, 1.0],
    "two equal": [1.5, 1.0, 1.0],
    "almost equal": [1.0 + 1e-6, 1.0, 1.0 - 1e-6],
    "far apart": [100.0, 1.0, 1e-3],
    "flat": [1.0, 0.5, 0.0],
    "a line": [2.0, 0.0, 0.0],
    "inverted": [1.2, 1.0, -0.4],
    "tiny": [1e-12, 5e-13, 1e-13],
    "huge": [1e15, 5e14, 1e14],
}


@pytest.mark.parametrize("name", HARD)
def test_decomposition_of_hard_matrices(name):
    """Rotations that stop early, or divide by a vanishing length, would crumple single faces."""
    rng = np.random.default_rng(0)
    values = np.array(HARD[name])
    phi = (rotations(200, rng) * values) @ rotations(200, rng)
    phi = torch.tensor(phi, dtype=torch.float32)
    top = np.abs(values).max()
    exact = np.linalg.svd(phi.numpy().astype(float), compute_uv=False)
    # one rounding of a float64 result
    np.testing.assert_allclose(deformation.singular_values(phi).numpy(), exact, atol=1e-7 * top, rtol=1e-7)
    asked = torch.tensor([1.3, 1.1, 0.7]).expand(200, 3).contiguous()
    replaced = deformation.replace_singular_values(phi, asked).numpy().astype(float)
    np.testing.assert_allclose(np.linalg.svd(replaced, compute_uv=False), asked.numpy(), atol=3e-7)
    assert (np.linalg.det(replaced) > 0).all()
    if name in ("cloth", "far apart", "inverted", "tiny", "huge", "flat"):  # elsewhere U and V are not unique
        exact = reference.replace_singular_values(phi.numpy(), asked.numpy())
        np.testing.assert_allclose(replaced, exact, atol=2e-7)


def next_of(phi: torch.Tensor, asked: torch.Tensor) -> np.ndarray:
    """The gradients of the next frame for steps `phi` from undeformed faces."""
    count = len(phi)
    features = torch.eye(3).flatten().repeat(count, 1)
    owner = torch.zeros(count, dtype=torch.int32)
    return next_gradients(features, phi, asked, torch.zeros(1, 3), owner, owner, 1)[0].numpy()


@pytest.mark.parametrize("name", HARD)
def test_eight_hard_matrices_at_a_time(name):
    """Lanes that are done would be turned further, or those of flat faces divided by zero. Roundings of float32."""
    rng = np.random.default_rng(1)
    others = [HARD[key] for key in HARD if key not in ("tiny", "huge")]
    values = np.array([others[k % len(others)] if k % 3 else HARD[name] for k in range(203)])
    phi = torch.tensor((rotations(203, rng) * values[:, None]) @ rotations(203, rng), dtype=torch.float32)
    asked = torch.tensor([1.3, 1.1, 0.7]).expand(203, 3).contiguous()
    found = next_of(phi, asked)
    np.testing.assert_allclose(np.linalg.svd(found.astype(float), compute_uv=False), asked.numpy(), atol=3e-7)
    assert (np.linalg.det(found) > 0).all()
    unique = [k for k in range(203) if len(set(np.abs(values[k]).round(3))) == 3]
    exact = reference.replace_singular_values(phi.numpy(), asked.numpy())
    np.testing.assert_allclose(found[unique], exact[unique], atol=2e-7)
    assert np.array_equal(next_of(phi[3:], asked[3:]), found[3:])  # in other lanes


def test_decomposition_of_nothing_and_of_nan():
    """A matrix of zeros must become the values asked for, and NaN must not look like a number."""
    phi = torch.zeros(2, 3, 3)
    phi[1] = float("nan")
    asked = torch.tensor([[1.5, 1.0, 0.5]] * 2)
    replaced = deformation.replace_singular_values(phi, asked)
    np.testing.assert_allclose(np.linalg.svd(replaced[0].numpy())[1], asked[0].numpy(), atol=1e-6)
    assert torch.isnan(replaced[1]).any()
    assert torch.isnan(deformation.singular_values(phi)[1]).any()
    assert torch.count_nonzero(deformation.singular_values(phi)[0]) == 0


class Prediction:
    """A random prediction for 60 faces of three garments with four components."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.features = torch.tensor(rng.normal(size=(60, 34)), dtype=torch.float32)
        near = np.eye(3) + 0.1 * rng.normal(size=(60, 3, 3))
        self.psi = torch.tensor(near @ rotations(60, rng), dtype=torch.float32)
        self.values = torch.tensor(np.sort(rng.uniform(0.5, 1.5, (60, 3)))[:, ::-1].copy(), dtype=torch.float32)
        self.values[5, 2] = -0.3
        self.velocity = torch.tensor(rng.normal(size=(4, 3)), dtype=torch.float32)
        self.garment = torch.arange(60, dtype=torch.int32) // 20
        self.component = torch.minimum(torch.arange(60, dtype=torch.int32) // 15, torch.tensor(3, dtype=torch.int32))

    def next(self, **options):
        """Gradients of the next frame by the kernel."""
        arguments = (self.features, self.psi, self.values, self.velocity, self.component, self.garment, 3)
        return next_gradients(*arguments, **options)


@pytest.mark.parametrize("replace", [True, False])
def test_next_gradients_agree_with_lapack(replace, poisoned):
    """Faces would stretch or turn otherwise than the network said."""
    p = Prediction()
    target, finite = p.next(replace=replace, smallest=0.01)
    assert len(poisoned) == 1
    assert finite.tolist() == [True, True, True]
    phi = p.features[:, :9].reshape(-1, 3, 3).double().numpy()
    expected = p.psi.double().numpy() @ phi
    if replace:
        expected = reference.replace_singular_values(expected, p.values.clamp(min=0.01).numpy())
    np.testing.assert_allclose(target.numpy(), expected, rtol=1e-7, atol=1e-6 if replace else 1e-7)


@pytest.mark.parametrize("what", ["psi", "values", "velocity"])
def test_a_broken_garment_stays_alone(what):
    """NaN of one garment would reach the others of its batch through a solver, or nobody would notice it."""
    p, sound = Prediction(), Prediction().next()[0]
    rows = {"psi": (p.psi, 25), "values": (p.values, 39), "velocity": (p.velocity, 2)}
    tensor, row = rows[what]
    tensor[row].flatten()[1] = float("inf") if what == "values" else float("nan")
    target, finite = p.next()
    assert finite.tolist() == [True, False, True] if what != "velocity" else [True, False, False]
    broken = ~finite[p.garment.long()]
    assert torch.equal(target[~broken], sound[~broken])
    phi = p.features[:, :9].reshape(-1, 3, 3).numpy()
    kept = reference.replace_singular_values(phi, np.ones((60, 3)))
    np.testing.assert_allclose(target[broken].numpy(), kept[broken.numpy()], atol=1e-6)


def test_next_gradients_refuse_wrong_arguments():
    """Wrong shapes and dtypes must not reach a kernel."""
    p = Prediction()
    good = [p.features, p.psi, p.values, p.velocity, p.component, p.garment]
    wrong = [
        (0, p.features[:, :8], ValueError, "features"),
        (1, p.psi.double(), TypeError, "psi"),
        (2, p.values[1:], ValueError, "singular_values"),
        (3, p.velocity[0], ValueError, "velocity"),
        (4, p.component.long(), TypeError, "component_of_face"),
        (5, p.garment[1:], ValueError, "garment_of_face"),
    ]
    for position, value, error, word in wrong:
        with pytest.raises(error, match=word):
            next_gradients(*good[:position], value, *good[position + 1 :], 3)
    target, finite = next_gradients(*(t[:0] for t in good[:3]), p.velocity, *(t[:0] for t in good[4:]), 3)
    assert target.shape == (0, 3, 3)
    assert finite.all()


def test_face_means_agree_with_numpy(poisoned):
    """Garments would be centred on each other's means, or sums lose digits."""
    rng = np.random.default_rng(2)
    mesh = meshes.icosphere(4)
    vertices = torch.tensor(mesh.vertices + np.float32([100.0, 0.0, -3.0]))
    segment = rng.integers(0, 4, len(mesh.faces)).astype(np.int32)  # 4 is empty
    means = FaceMeans(torch.tensor(mesh.faces), torch.tensor(segment), 5, len(vertices))
    found = means(vertices)
    assert len(poisoned) == 1
    centroids = reference.face_centroids(vertices.numpy(), mesh.faces)
    expected = np.stack([centroids[segment == k].mean(0) if k < 4 else np.zeros(3) for k in range(5)])
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-7, atol=1e-7)  # one rounding of a float64 result
    assert torch.equal(found, means(vertices))
    with pytest.raises(ValueError, match="vertices"):
        means(vertices[1:])
    with pytest.raises(ValueError, match="segment must lie within"):
        FaceMeans(torch.tensor(mesh.faces), torch.tensor(segment), 3, len(vertices))
    with pytest.raises(ValueError, match="faces must lie within"):
        FaceMeans(torch.tensor(mesh.faces), torch.tensor(segment), 5, 7)


def test_gradients_of_face_means_are_those_of_the_mean():
    """Vertices would be pulled by another garment's mean, or as if each had one face. Against float64, 1e-6."""
    mesh, count = meshes.icosphere(3), 2
    faces = np.concatenate([mesh.faces, mesh.faces[5:] + len(mesh.vertices)])  # the second with vertices of no face
    vertices = torch.tensor(np.concatenate([mesh.vertices, 2.0 * mesh.vertices]), dtype=torch.float32)
    segment = torch.arange(2, dtype=torch.int32).repeat_interleave(torch.tensor([len(mesh.faces), len(mesh.faces) - 5]))
    owner = torch.arange(2, dtype=torch.int32).repeat_interleave(len(mesh.vertices))
    means = FaceMeans(torch.tensor(faces), segment, count, len(vertices), owner)
    weight = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    moved = vertices.clone().requires_grad_()
    found = means(moved)
    assert torch.equal(found.detach(), means(vertices))
    (found * weight).sum().backward()
    twin = vertices.double().requires_grad_()
    centroids = twin[torch.tensor(faces).long()].mean(1)
    sums = torch.zeros(count, 3, dtype=torch.float64).index_add(0, segment.long(), centroids)
    ((sums / torch.bincount(segment.long())[:, None]) * weight).sum().backward()
    torch.testing.assert_close(moved.grad.double(), twin.grad, rtol=1e-6, atol=1e-9)


def test_positions_that_are_not_finite_are_not_kept():
    """One garment's NaN would end another garment, or a frame be taken from a garment that has failed before. NumPy,
    exact; outputs are poisoned."""
    rng = np.random.default_rng(0)
    start = np.array([0, 5, 5, 9, 20], np.int32)
    new, old = (rng.normal(size=(20, 3)).astype(np.float32) for _ in range(2))
    new[7, 1], new[15, 2] = np.nan, np.inf
    finite = np.array([True, True, True, False])
    kept, still = keep_finite(*map(torch.from_numpy, (start, new, old, finite)))
    assert still.tolist() == [True, True, False, False]
    np.testing.assert_array_equal(kept, np.concatenate([new[:5], old[5:]]))
    for wrong in ((new.astype(float), old), (new, old[1:])):
        with pytest.raises((TypeError, ValueError), match="must"):
            keep_finite(torch.from_numpy(start), *map(torch.from_numpy, wrong), torch.from_numpy(finite))
