"""Frames, deformation gradients and singular values against float64 NumPy; gradients against finite differences and
float64 torch."""

import numpy as np
import pytest
import torch
from reference import deformation as reference
from reference.finite_differences import numeric_gradient
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import deformation
from warpgarment.kernels.deformation.replaced import MAX_GAIN

GARMENTS = meshes.garments()


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def pair(name: str, scale: float = 1.0):
    """Rest and moved vertices, and faces, as tensors."""
    rest = GARMENTS[name].scaled(scale)
    return torch.tensor(rest.vertices), torch.tensor(meshes.moved(rest).vertices), torch.tensor(rest.faces)


def rotations(count: int, seed: int = 0) -> np.ndarray:
    """Random proper rotations, float64."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def matrices(values: np.ndarray, seed: int = 0) -> torch.Tensor:
    """U diag(values) Vᵀ with random rotations, float32 [n, 3, 3]."""
    u, v = rotations(len(values), seed), rotations(len(values), seed + 1)
    return torch.tensor(u @ (values[:, :, None] * v), dtype=torch.float32)


def assert_close(actual: torch.Tensor, expected: np.ndarray, tolerance: float) -> None:
    """Largest error, relative to the largest expected entry."""
    actual = actual.detach().numpy().astype(np.float64)
    assert actual.shape == expected.shape
    assert np.isfinite(actual).all()
    assert np.abs(actual - expected).max() <= tolerance * np.abs(expected).max()


@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", GARMENTS)
def test_frames_and_gradients_agree_with_numpy(name, scale, poisoned):
    """A wrong edge, normal or rest inverse would deform every garment."""
    rest, moved, faces = pair(name, scale)
    r, m, f = rest.numpy(), moved.numpy(), faces.numpy()
    # A few float32 roundings; the rest inverse multiplies them by the aspect ratio of the thinnest face, about 10.
    assert_close(deformation.face_frames(moved, faces)[:, :, :2], reference.face_frames(m, f)[:, :, :2], 1e-6)
    assert_close(deformation.face_normals(moved, faces), reference.face_frames(m, f)[:, :, 2], 2e-6)
    assert_close(deformation.face_centroids(moved, faces), reference.face_centroids(m, f), 1e-6)
    phi = deformation.deformation_gradient(rest, moved, faces)
    assert_close(phi, reference.deformation_gradient(r, m, f), 3e-6)
    inverse = deformation.inverse_rest_frames(rest, faces)
    assert_close(deformation.deformation_gradient_from_inverse(inverse, moved, faces), phi.numpy().astype(float), 0.0)
    assert_close(deformation.singular_values(phi), reference.singular_values(phi.numpy()), 2e-7)
    assert len(poisoned) == 8


@pytest.mark.parametrize("name", GARMENTS)
def test_vertex_gradients_agree_with_finite_differences(name):
    """Losses on frames, centroids or deformation gradients would push vertices the wrong way."""
    rest, moved, faces = pair(name)
    rng = np.random.default_rng(3)
    w = rng.normal(size=(len(faces), 3, 3)) * [1.0, 1.0, 0.1]
    c = rng.normal(size=(len(faces), 3))
    r, f = rest.numpy(), faces.numpy()
    weight, centre = torch.tensor(w, dtype=torch.float32), torch.tensor(c, dtype=torch.float32)
    cases = [
        (
            lambda v: (deformation.face_frames(v, faces) * weight).sum(),
            lambda v: (reference.face_frames(v, f) * w).sum(),
        ),
        (
            lambda v: (deformation.face_centroids(v, faces) * centre).sum(),
            lambda v: (reference.face_centroids(v, f) * c).sum(),
        ),
        (
            lambda v: (deformation.deformation_gradient(rest, v, faces) * weight).sum(),
            lambda v: (reference.deformation_gradient(r, v, f) * w).sum(),
        ),
    ]
    for ours, twin in cases:
        vertices = moved.clone().requires_grad_()
        ours(vertices).backward()
        # Float32 sums over up to 8 faces
        assert_close(vertices.grad, numeric_gradient(twin, moved.numpy(), 1e-6), 1e-5)


@pytest.mark.parametrize("scale", meshes.SCALES)
def test_relative_gradient_undoes_multiplication(scale):
    """Ψ Φ would not give the next frame back."""
    rng = np.random.default_rng(0)
    phi, phi_next = (matrices(rng.uniform(0.7, 1.4, (300, 3)), s) for s in (5, 8))
    phi, phi_next = (phi * scale).requires_grad_(), phi_next.requires_grad_()
    psi = deformation.relative_deformation_gradient(phi_next, phi)
    a, b = phi_next.detach().numpy(), phi.detach().numpy()
    assert_close(psi, reference.relative_deformation_gradient(a, b), 2e-7)  # one rounding of a float64 result
    w = rng.normal(size=(300, 3, 3))
    (psi * torch.tensor(w, dtype=torch.float32)).sum().backward()
    a64, b64 = (t.detach().double().requires_grad_() for t in (phi_next, phi))
    (a64 @ torch.linalg.inv(b64) * torch.tensor(w)).sum().backward()
    assert_close(phi_next.grad, a64.grad.numpy(), 1e-6)
    assert_close(phi.grad, b64.grad.numpy(), 1e-6)


@pytest.mark.parametrize("scale", meshes.SCALES)
def test_singular_values_agree_with_lapack(scale):
    """Values out of order, negative for an inverted face, or wrong at 2e-4 as in float32, would be fed to the
    network."""
    rng = np.random.default_rng(1)
    mirrored = [[1.0, 0.8, -0.5]]
    special = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.2], [2.0, 0.5, 0.5], [1.0, 0.5, 0.0], [1.0, 0.0, 0.0], *mirrored])
    phi = torch.cat(
        [matrices(rng.uniform(0.1, 3.0, (500, 3))), matrices(special), torch.eye(3)[None], torch.zeros(1, 3, 3)]
    )
    phi = phi * scale
    values = deformation.singular_values(phi)
    assert_close(values, reference.singular_values(phi.numpy()), 2e-7)  # one rounding of a float64 result
    assert (values >= 0).all()
    assert (values[:, :-1] >= values[:, 1:]).all()


def test_singular_value_gradient():
    """Stretch losses would pull along the wrong axes; mirrored matrices would be pulled the wrong way."""
    rng = np.random.default_rng(2)
    values = np.sort(rng.uniform(0.3, 2.0, (200, 3)))[:, ::-1] * np.where(rng.random((200, 1)) < 0.3, [1, 1, -1], 1.0)
    values = values[np.diff(-np.abs(values), axis=1).min(axis=1) > 0.02]
    phi = matrices(values).requires_grad_()
    weight = torch.tensor(rng.normal(size=values.shape))
    (deformation.singular_values(phi) * weight.float()).sum().backward()
    twin = phi.detach().double().requires_grad_()
    (torch.linalg.svdvals(twin) * weight).sum().backward()
    assert_close(phi.grad, twin.grad.numpy(), 1e-6)


def test_sum_of_singular_values_has_a_gradient_where_they_repeat():
    """An undeformed garment, whose values are all 1, would send NaN through training. The gradient of their sum is
    the rotation."""
    turned = torch.tensor(rotations(50), dtype=torch.float32)
    phi = torch.cat([torch.eye(3)[None], turned]).requires_grad_()
    deformation.singular_values(phi).sum().backward()
    assert_close(phi.grad, phi.detach().numpy().astype(float), 1e-6)


@pytest.mark.parametrize("scale", meshes.SCALES)
def test_replaced_values_are_proper_and_as_asked(scale):
    """Faces would keep their old stretch, or turn inside out."""
    rng = np.random.default_rng(4)
    old = np.sort(rng.uniform(0.3, 2.0, (300, 3)))[:, ::-1] * np.where(rng.random((300, 1)) < 0.3, [1, 1, -1], 1.0)
    phi = matrices(old) * scale
    new = torch.tensor(np.sort(rng.uniform(0.5, 1.5, (300, 3)))[:, ::-1].copy(), dtype=torch.float32)
    replaced = deformation.replace_singular_values(phi, new)
    assert_close(replaced, reference.replace_singular_values(phi.numpy(), new.numpy()), 2e-7)
    assert (torch.linalg.det(replaced) > 0).all()
    assert_close(torch.linalg.svdvals(replaced.double()), new.double().numpy(), 2e-7)
    negative = deformation.replace_singular_values(phi, new * torch.tensor([1.0, 1.0, -1.0]))
    assert_close(negative, replaced.numpy().astype(float), 0.0)


def test_own_values_change_nothing():
    """Replacing the values of a proper matrix by its own must be the identity, repeated values or not."""
    values = np.array([[1.0, 1.0, 1.0], [1.2, 1.2, 0.7], [1.0, 0.4, 0.4], [3.0, 2.0, 1.0]])
    phi = matrices(values)
    assert_close(
        deformation.replace_singular_values(phi, torch.tensor(values).float()), phi.numpy().astype(float), 5e-7
    )


def test_rotation_is_the_polar_factor():
    """The rotation that carries skin would scale or mirror cloth."""
    rng = np.random.default_rng(6)
    old = np.sort(rng.uniform(0.3, 2.0, (300, 3)))[:, ::-1] * np.where(rng.random((300, 1)) < 0.3, [1, 1, -1], 1.0)
    phi = matrices(old)
    turned = deformation.rotation(phi)
    assert_close(turned @ turned.transpose(1, 2), np.broadcast_to(np.eye(3), (300, 3, 3)), 1e-6)
    assert_close(torch.linalg.det(turned.double()), np.ones(300), 1e-6)
    assert_close(turned, reference.replace_singular_values(phi.numpy(), np.ones((300, 3))), 2e-7)


def gradients_of_replacement(phi: torch.Tensor, values: np.ndarray, weight: np.ndarray):
    """Gradients of the replacement by the kernel, in phi and in the values."""
    phi = phi.clone().requires_grad_()
    s = torch.tensor(values, dtype=torch.float32, requires_grad=True)
    (deformation.replace_singular_values(phi, s) * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    return phi.grad, s.grad


def test_replacement_gradient_agrees_with_float64_torch():
    """Training through rollouts would follow wrong gradients (well separated values: torch is exact there)."""
    rng = np.random.default_rng(7)
    old, new = np.sort(rng.uniform(0.3, 2.0, (2, 400, 3)))[:, :, ::-1]
    keep = np.diff(-old, axis=1).min(axis=1) > 0.1
    old, new = old[keep], new[keep].astype(np.float32).astype(float)
    weight = rng.normal(size=(len(old), 3, 3))
    phi = matrices(old)
    ours, ours_values = gradients_of_replacement(phi, new, weight)
    twin, twin_values = phi.double().requires_grad_(), torch.tensor(new, requires_grad=True)
    u, _, vt = torch.linalg.svd(twin)
    (u @ torch.diag_embed(twin_values) @ vt * torch.tensor(weight)).sum().backward()
    assert_close(ours, twin.grad.numpy(), 1e-6)
    assert_close(ours_values, twin_values.grad.numpy(), 1e-6)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ([1.001, 1.0, 0.999], [1.002, 1.0, 0.9985]),  # nearly undeformed, the new values likewise
        ([1.0001, 1.0, 0.9], [1.0003, 1.0, 0.8]),
        ([1.3, 0.7, 0.5], [-1.1, 0.9, 0.4]),  # a negative value counts as its magnitude
        ([1.3, 0.7, -0.5], [1.1, 0.9, 0.4]),  # inverted
        ([1.3, 0.7, 0.0], [1.1, 0.9, 0.4]),  # flat
    ],
)
def test_replacement_gradient_agrees_with_finite_differences(old, new):
    """Nearly undeformed, inverted or flat faces, where torch's own gradient is no judge, would get wrong or wild
    gradients."""
    rng = np.random.default_rng(8)
    weight = rng.normal(size=(1, 3, 3))
    phi = matrices(np.array([old]), 20)
    new = np.array([new], np.float32).astype(float)
    ours, ours_values = gradients_of_replacement(phi, new, weight)
    expected = numeric_gradient(lambda p: (reference.replace_singular_values(p, new) * weight).sum(), phi.numpy(), 1e-7)
    # phi is rounded to 6e-8; where values are 1e-4 apart that turns singular vectors, and with them the gradient, by
    # 1e-3 at most
    assert_close(ours, expected, 2e-3)
    s_expected = numeric_gradient(
        lambda s: (reference.replace_singular_values(phi.numpy(), s) * weight).sum(), new, 1e-6
    )
    assert_close(ours_values, s_expected, 2e-3)


def test_replacement_gradient_is_bounded_where_values_repeat():
    """An undeformed face (a rotation, the identity, zero) with new values that differ has no gradient: it must not be
    NaN or huge."""
    rng = np.random.default_rng(9)
    phi = torch.cat([torch.eye(3)[None], torch.zeros(1, 3, 3), -torch.eye(3)[None], matrices(np.ones((50, 3)))])
    weight = rng.normal(size=(len(phi), 3, 3))
    new = rng.uniform(0.9, 1.1, (len(phi), 3))
    ours, ours_values = gradients_of_replacement(phi, new, weight)
    assert torch.isfinite(ours).all()
    assert torch.isfinite(ours_values).all()
    bound = float(MAX_GAIN) * np.linalg.norm(weight, axis=(1, 2))
    assert (np.linalg.norm(ours.numpy(), axis=(1, 2)) <= 1.0001 * bound).all()
    # With equal new values there is one: that of the polar rotation, d = w for skew directions and none for symmetric
    # ones.
    ours, _ = gradients_of_replacement(phi[:1], np.ones((1, 3)), weight[:1])
    assert_close(ours, 0.5 * (weight[:1] - weight[:1].transpose(0, 2, 1)), 1e-6)


def test_incoming_gradients_survive():
    """Warp's adjoint writes into the gradients it is given: autograd's own copy must not change (warp issues 1732,
    1737)."""
    phi = matrices(np.full((5, 3), 1.0) * [1.2, 1.0, 0.8]).requires_grad_()
    incoming = torch.randn(5, 3, 3)
    before = incoming.clone()
    out = deformation.replace_singular_values(phi, torch.ones(5, 3))
    first = torch.autograd.grad(out, phi, incoming, retain_graph=True)[0]
    second = torch.autograd.grad(out, phi, incoming.expand(5, 3, 3))[0]
    assert torch.equal(incoming, before)
    assert torch.equal(first, second)


def test_degenerate_and_dangling_faces_stay_finite_or_say_nan():
    """A collapsed face must not spread NaN into its neighbours; a face naming a missing vertex must not read foreign
    memory."""
    rest, moved, faces = pair("tetrahedron")
    moved[2] = moved[1]
    vertices = moved.requires_grad_()
    phi = deformation.deformation_gradient(rest, vertices, faces)
    phi.sum().backward()
    assert torch.isfinite(phi).all()
    assert torch.isfinite(vertices.grad).all()
    assert torch.isfinite(deformation.singular_values(phi)).all()
    broken = faces.clone()
    broken[1, 2], broken[2, 0] = 4, -1
    vertices.grad = None
    frames = deformation.face_frames(vertices, broken)
    frames[[0, 3]].sum().backward()
    assert torch.isnan(frames[1:3]).all()
    assert torch.isfinite(frames[[0, 3]]).all()
    assert torch.isfinite(vertices.grad).all()


def test_segment_mean():
    """Means of components would mix garments, or drift with the number of faces."""
    rng = np.random.default_rng(10)
    values, segment = rng.normal(size=(1000, 3)).astype(np.float32) + 5, rng.integers(0, 4, 1000).astype(np.int32)
    tensor = torch.tensor(values, requires_grad=True)
    means = deformation.segment_mean(tensor, torch.tensor(segment), 5)
    assert_close(means, reference.segment_mean(values, segment, 5), 1e-7)
    w = rng.normal(size=(5, 3))
    (means * torch.tensor(w, dtype=torch.float32)).sum().backward()
    assert_close(tensor.grad, w[segment] / np.bincount(segment)[segment][:, None], 1e-6)


def test_nothing_in_nothing_out():
    """Empty batches must pass through, gradients included."""
    vertices, faces = torch.zeros(0, 3, requires_grad=True), torch.zeros(0, 3, dtype=torch.int32)
    phi = deformation.deformation_gradient(torch.zeros(0, 3), vertices, faces)
    s = deformation.singular_values(phi)
    out = deformation.replace_singular_values(phi, s)
    assert phi.shape == out.shape == deformation.rotation(phi).shape == (0, 3, 3)
    assert s.shape == deformation.face_normals(vertices, faces).shape == (0, 3)
    assert deformation.face_centroids(vertices, faces).shape == (0, 3)
    assert deformation.relative_deformation_gradient(phi, phi).shape == (0, 3, 3)
    assert deformation.segment_mean(s, torch.zeros(0, dtype=torch.int32), 2).shape == (2, 3)
    out.sum().backward()
    assert vertices.grad.shape == (0, 3)


def test_layout_does_not_matter():
    """Transposed or strided tensors would be read as if they were contiguous."""
    rest, moved, faces = pair("irregular_grid")
    phi = deformation.deformation_gradient(rest, moved, faces)
    strided = torch.stack([moved, moved], dim=2)[:, :, 1]
    columns = faces.T.contiguous().T
    assert torch.equal(deformation.deformation_gradient(rest, strided, columns), phi)
    turned = deformation.singular_values(phi.transpose(1, 2))
    assert_close(turned, reference.singular_values(phi.numpy()), 3e-7)


@pytest.mark.parametrize(
    ("call", "error", "word"),
    [
        (lambda v, f: deformation.face_frames(v.double(), f), TypeError, "vertices"),
        (lambda v, f: deformation.face_frames(v, f.long()), TypeError, "faces"),
        (lambda v, f: deformation.face_frames(v[:, :2], f), ValueError, "vertices"),
        (lambda v, f: deformation.face_centroids(v, f[0]), ValueError, "faces"),
        (lambda v, f: deformation.face_normals(v.numpy(), f), TypeError, "tensor"),
        (lambda v, f: deformation.deformation_gradient(v[1:], v, f), ValueError, "rest_vertices"),
        (
            lambda v, f: deformation.deformation_gradient_from_inverse(torch.eye(3)[None], v, f),
            ValueError,
            "inverse_rest",
        ),
        (lambda v, f: deformation.singular_values(v), ValueError, "phi"),
        (lambda v, f: deformation.rotation(torch.eye(2)[None]), ValueError, "phi"),
        (lambda v, f: deformation.replace_singular_values(torch.eye(3)[None], v), ValueError, "s must"),
        (
            lambda v, f: deformation.relative_deformation_gradient(torch.eye(3), torch.eye(3)[None]),
            ValueError,
            "phi_next",
        ),
        (lambda v, f: deformation.segment_mean(v, f[:, 0], 1), ValueError, "segment"),
    ],
)
def test_wrong_arguments_are_refused(call, error, word):
    """A wrong dtype or shape would be read as garbage by a kernel."""
    _, moved, faces = pair("skirt")
    with pytest.raises(error, match=word):
        call(moved, faces)


def test_operators_keep_torch_contracts():
    """Operators would break under torch.compile, export or autograd (schema, fake shapes, backward registration)."""
    rest, moved, faces = pair("tetrahedron")
    inverse, v = deformation.inverse_rest_frames(rest, faces), moved.requires_grad_()
    phi = deformation.deformation_gradient(rest, moved, faces).detach().requires_grad_()
    s = torch.ones(len(faces), 3, requires_grad=True)
    operators = torch.ops.warpgarment
    for operator, arguments in [
        (operators.face_frames, (v, faces)),
        (operators.face_centroids, (v, faces)),
        (operators.inverse_rest_frames, (rest, faces)),
        (operators.deformation_gradient, (inverse, v, faces)),
        (operators.relative_deformation_gradient, (phi, phi.detach().clone().requires_grad_())),
        (operators.singular_values, (phi,)),
        (operators.replace_singular_values, (phi, s)),
    ]:
        torch.library.opcheck(operator.default, arguments)
