"""A limb that rises through cloth during a rollout: the simulator hands to collision refinement where vertices were."""

import numpy as np
import pytest
import torch
from support import meshes
from support.scenes import network

from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.stages.contact import Contact
from warpgarment.sim.stages.reconstruct import Reconstruct


@pytest.mark.parametrize("remembers", [True, False])
def test_a_rollout_remembers_on_which_side_cloth_is(monkeypatch, remembers):
    """Cloth that would stay where it is, and a limb 8 cm thick that comes up under it at 5 cm a frame."""
    solve = Reconstruct.__call__
    monkeypatch.setattr(
        Reconstruct, "__call__", lambda self, vertices, *rest: (vertices, solve(self, vertices, *rest)[1])
    )
    if not remembers:
        monkeypatch.setattr(Contact, "origin", lambda self, vertices, _: torch.full_like(vertices, torch.nan))
    sheet, limb = meshes.sheet_and_limb()
    cloth = Garment(sheet.vertices, sheet.faces)
    rise = 0.05 * np.arange(4)[:, None, None] * np.float32([0.0, 1.0, 0.0])
    body = BodyMotion(limb.vertices + rise, limb.faces, 30.0)
    result = Simulator(network(), "cpu", epsilon=0.004).rollout(cloth, body)
    axis = body.vertices[-1, :, 1].mean()
    middle = np.abs(cloth.vertices[:, 2]) < 0.02
    assert middle.sum() > 10
    above = result.vertices[-1, middle, 1] > axis
    assert above.all() if remembers else above.mean() < 0.5
