"""What the network's numbers mean: the two parametrisations against each other and against rigid motion."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.spatial.transform
import torch

from warpgarment.kernels.features.channels import FEATURES, LAYOUT
from warpgarment.nn.parametrisation import NetworkOutput, Step, component_mean, compose, context, targets

COMPONENT = torch.tensor([[0, 0, 1, 1, 1, 0], [0, 1, 2, 2, 0, 1]])


def random_features(seed: int = 0) -> torch.Tensor:
    """Features of 2 garments of 6 faces whose body deformations are mild, as those between frames are."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(2, 6, FEATURES, generator=generator)
    noise = 0.3 * torch.randn(2, 6, 3, 3, generator=generator)
    features[..., LAYOUT["body_deformation"]] = (torch.eye(3) + noise).flatten(-2)
    return features


def random_step(seed: int = 1) -> Step:
    """A random step."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((2, 6, 3, 3), (2, 6, 3), (2, 3, 3))
    return Step(*(torch.randn(shape, generator=generator) for shape in shapes))


@pytest.mark.parametrize("residual", [False, True])
def test_compose_and_targets_are_inverses(residual):
    """Training would teach something else than the simulator reads. 2e-6: two float32 products of rotations."""
    ground = context(random_features(), COMPONENT, 3)
    step = random_step()
    for a, b in zip(compose(targets(step, ground, residual=residual), ground, residual=residual), step, strict=True):
        assert (a - b).abs().max() < 2e-6
    back = targets(compose(step, ground, residual=residual), ground, residual=residual)
    for a, b in zip(back, step, strict=True):
        assert (a - b).abs().max() < 2e-6


def test_both_parametrisations_express_the_same_step():
    """Networks of the two kinds could not be compared. 2e-6 as above."""
    ground = context(random_features(), COMPONENT, 3)
    step = random_step()
    plain = compose(targets(step, ground, residual=False), ground, residual=False)
    residual_output = targets(step, ground, residual=True)
    for a, b in zip(compose(residual_output, ground, residual=True), plain, strict=True):
        assert (a - b).abs().max() < 2e-6
    for name in ("psi", "velocity"):
        assert (getattr(residual_output, name) - getattr(step, name)).abs().max() > 0.1  # and yet different numbers
    assert torch.equal(residual_output.singular_values, step.singular_values)  # absolute in both


def test_context_matches_scipy():
    """The residual would be taken against another rotation or another mean velocity than documented.

    SciPy's polar decomposition in float64; 1e-5 for its condition in float32.
    """
    features = random_features()
    ground = context(features, COMPONENT, 3)
    deformation = features[..., LAYOUT["body_deformation"]].reshape(2, 6, 3, 3).double().numpy()
    velocity = features[..., LAYOUT["body_velocity"]].double().numpy()
    for b in range(2):
        for i in range(6):
            if np.linalg.det(deformation[b, i]) > 0:
                expected = scipy.linalg.polar(deformation[b, i])[0]
                assert np.abs(ground.body_rotation[b, i].numpy() - expected).max() < 1e-5
        for c in range(3):
            mine = COMPONENT[b].numpy() == c
            expected = velocity[b, mine].mean(axis=0) if mine.any() else np.zeros(3)
            assert np.abs(ground.body_velocity[b, c].numpy() - expected).max() < 1e-6


def test_context_reads_the_newest_frame_only():
    """A residual would refer to frames long gone, or to padding. Exact, padding poisoned with NaN."""
    features = random_features()
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[1, 4:] = False
    padded = features.clone()
    padded[~mask] = torch.nan
    stacked = torch.cat([torch.full((2, 6, 2 * FEATURES), torch.nan), padded], dim=-1)
    ground = context(stacked, COMPONENT, 3, mask)
    alone = context(features[1:, :4], COMPONENT[1:, :4], 3)
    whole = context(features[:1], COMPONENT[:1], 3)
    assert torch.equal(ground.body_rotation[1, :4], alone.body_rotation[0])
    assert torch.equal(ground.body_velocity[1], alone.body_velocity[0])
    assert torch.equal(ground.body_velocity[0], whole.body_velocity[0])


def test_packed_and_padded_agree():
    """Simulation, which is packed, and training, which is padded, would differ. 1e-6: order of sums."""
    features = random_features()
    padded = context(features, COMPONENT, 3)
    packed = context(features.flatten(0, 1), torch.cat([COMPONENT[0], COMPONENT[1] + 3]), 6)
    assert torch.equal(padded.body_rotation.flatten(0, 1), packed.body_rotation)
    assert (padded.body_velocity.flatten(0, 1) - packed.body_velocity).abs().max() < 1e-6


def test_component_mean_of_nothing_is_zero():
    """A component whose faces all lie in another subset would divide by zero."""
    mean = component_mean(torch.ones(2, 3), torch.tensor([0, 0]), 2)
    assert torch.equal(mean, torch.tensor([[1.0, 1, 1], [0, 0, 0]]))


def test_zero_residual_is_rigid_motion_on_a_rigid_body():
    """The prior would not be "moves like skin". The body turns by Q: Psi must be Q, q the body's; 1e-6."""
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix().astype(np.float32)
    features = torch.zeros(4, FEATURES)
    features[:, LAYOUT["body_deformation"]] = torch.from_numpy(turn).flatten()
    features[:, LAYOUT["body_velocity"]] = torch.tensor([0.01, 0.02, 0.03])
    features[:, LAYOUT["singular_values"]] = torch.tensor([1.2, 1.0, 0.9])
    zero = (torch.eye(3).expand(4, 3, 3), torch.ones(4, 3), torch.zeros(1, 3))
    ground = context(features, torch.zeros(4, dtype=torch.int32), 1)
    step = compose(NetworkOutput(*zero), ground, residual=True)
    assert (step.psi - torch.from_numpy(turn)).abs().max() < 1e-6
    assert (step.velocity - torch.tensor([0.01, 0.02, 0.03])).abs().max() < 1e-6
    assert (step.singular_values == 1.0).all()  # stretch is absolute: 1.2 of this frame does not last
