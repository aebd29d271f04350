"""The heading of rows and what depends on it, beside the same in float64."""

import pytest
import torch
from support.comparing import close
from support.poison import poison_outputs

from warpgarment.kernels.dense import heading as heads
from warpgarment.kernels.features.channels import FACE, FEATURES, LAYOUT
from warpgarment.nn.patches.fused import factors

FRAMES, WIDTH = 3, 8
INDEX = torch.tensor([[4, 2, 9, 0, 1], [8, 3, 5, -1, -1]])  # packed faces of two rows; 6 and 7 are of neither
PIECE = torch.tensor([[1, 2], [0, -1]])
PIECE_OF_FACE = torch.tensor([2, 1, 1, 0, 1, 0, 0, 0, 0, 1], dtype=torch.int32)


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def model(canonical: bool) -> heads.Model:
    scale = torch.cat([normal(3).abs() + 0.5, normal(3)])
    return heads.Model(*factors(FACE), scale, normal(WIDTH, 3 * (FRAMES - 1)), normal(WIDTH), canonical)


def found_of(features: torch.Tensor, given: heads.Model) -> tuple[heads.Heading, torch.Tensor, heads.Rows]:
    rows, velocity = heads.Rows(INDEX, PIECE, PIECE_OF_FACE), normal(3, 3 * (FRAMES - 1))
    columns = (LAYOUT[name].start for name in ("deformation_gradient", "body_velocity"))
    return heads.heading(features[:, -FEATURES:], velocity, rows, given, *columns), velocity, rows


@pytest.mark.parametrize("canonical", [False, True])
def test_rows_beside_float64(canonical, monkeypatch):
    """A garment would be turned by another's heading, padding be heard, or velocities be those of other pieces."""
    poison_outputs(monkeypatch)
    features = normal(10, FRAMES * FEATURES)
    features[6:8] = torch.nan
    given = model(canonical)
    found, velocity, rows = found_of(features, given)
    deviation, mean = given.scale.double().split(3)
    result, said = torch.full((3, 3), torch.nan), normal(2, 2, 3)
    heads.velocities(said, found, rows, given.scale, result, residual=True)
    for r in range(2):
        faces = INDEX[r][INDEX[r] >= 0]
        newest = features[faces, -FEATURES:].double()
        total = newest[:, LAYOUT["deformation_gradient"]].sum(0).reshape(3, 3)
        angle = torch.atan2(total[0, 2] - total[2, 0], total[0, 0] + total[2, 2]) * canonical
        cos, sin = angle.cos().item(), angle.sin().item()
        turn = torch.tensor([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]], dtype=torch.float64)
        close(found.turn[r], turn, 1e-6)
        close(found.turns[r].reshape(FEATURES, -1)[:, :FEATURES], FACE.turn(turn[None])[0], 1e-6)
        assert not found.turns[r].reshape(FEATURES, -1)[:, FEATURES:].any()
        for c, piece in enumerate(PIECE[r].tolist()):
            if piece < 0:
                assert not found.tokens[r, c].any()
                continue
            past = velocity[piece].double().reshape(-1, 3) @ turn.T
            close(found.tokens[r, c], given.weight.double() @ ((past - mean) / deviation).flatten() + given.bias, 1e-5)
            around = newest[PIECE_OF_FACE[faces] == piece][:, LAYOUT["body_velocity"]].mean(0)
            close(found.around[r, c], around, 1e-6)
            close(result[piece], turn.T @ (deviation * said[r, c].double() + mean) + around, 1e-5)


def test_no_heading():
    """A garment whose gradients have no yaw would be turned by NaN. Exact."""
    found, *_ = found_of(torch.zeros(10, FRAMES * FEATURES), model(True))
    assert torch.equal(found.turn, torch.eye(3).expand(2, 3, 3))


def test_velocities_that_are_absolute():
    """Without the residual parametrisation the body's velocity would be added twice."""
    found, _, rows = found_of(normal(10, FRAMES * FEATURES), model(True))
    said, scale = normal(2, 2, 3), torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    result = torch.full((3, 3), torch.nan)
    heads.velocities(said, found, rows, scale, result, residual=False)
    close(result[0], found.turn[1].double().T @ said[1, 0].double(), 1e-6)
