"""The gate on sequences: a garment that comes off its body is refused, one that moves with it is not."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from support import meshes

from warpgarment.objects.garment import Garment
from warpgarment.training.generate.quality import Limits, QualityGate


def reasons(shift: np.ndarray, turn: np.ndarray | None = None) -> tuple[list[str | None], QualityGate]:
    """What the gate says of a tube around a ball, frame by frame: both turn, and the tube is moved besides.

    Args:
        shift: Motion of the tube relative to the ball [m], [T,3].
        turn: Rotation vector of both, [T,3]; None: none.
    """
    ball = meshes.icosphere(2, 0.2)
    sheet = meshes.icosphere(2, 0.25)
    faces = sheet.faces[np.abs(sheet.vertices[sheet.faces][:, :, 1]).max(axis=1) < 0.2]
    used, packed = np.unique(faces, return_inverse=True)
    tube = Garment(sheet.vertices[used], packed.reshape(-1, 3).astype(np.int32))
    # it may go through the ball: that is another limit
    gate, found = QualityGate((tube,), ball.faces, Limits(penetration=9.0), every=1), []
    for frame, moved in enumerate(shift):
        about = Rotation.from_rotvec(np.zeros(3) if turn is None else turn[frame]).as_matrix().T
        going = np.array([0.05 * frame, 0.0, 0.0])  # the ball goes 5 cm a frame, so that the speed limit lets all pass
        cloth = (tube.vertices + moved) @ about + going
        found.append(gate.check(frame, cloth.astype(np.float32), (ball.vertices @ about + going).astype(np.float32)))
    return found, gate


def test_a_garment_that_falls_off_is_refused():
    """A jacket that nothing holds would fall to the floor and on, and be the truth that networks learn from."""
    fall = np.zeros((12, 3))
    fall[:, 1] = -0.06 * np.arange(12)
    found, gate = reasons(fall)
    first = next(k for k, reason in enumerate(found) if reason)
    assert first == 9  # 54 cm, the first one over 50
    assert found[first].startswith("frame 9: off 540.0 mm is over 500 mm")
    assert abs(gate.figures(12)["off"] - 0.66) < 1e-4


def test_a_garment_that_moves_with_its_body_is_kept():
    """A dancer who walks away and turns would lose every sequence."""
    turn = np.linspace(0, 3.0, 20)[:, None] * [0.2, 1.0, -0.1]
    found, gate = reasons(np.tile([0.1, 0.0, 0.0], (20, 1)), turn)
    assert not any(found)
    assert gate.figures(20)["off"] < 1e-3
