"""The picture of one dress in three fabrics and winds: what is beside what, and when the teacher runs."""

from __future__ import annotations

import json
import sys
import types

import numpy as np
import pytest
import torch

from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.nn.faces.grow import added
from warpgarment.training.tables.outdoor import picture
from warpgarment.training.teachers import TEACHERS, TeacherEntry


class Blown:
    """A teacher whose cloth moves with the wind, farther the lighter it is; it counts its simulations."""

    name, simulated = "blown", 0

    def simulate(self, scene):
        Blown.simulated += 1
        (cloth,) = scene.cloths
        for frame in range(len(scene)):
            yield (cloth.first + 0.01 * frame * scene.wind[frame] / cloth.material.density).astype(np.float32)

    def settings(self):
        return {"teacher": self.name}


@pytest.fixture
def network(tmp_path):
    """`fast` with random weights for wind and materials."""
    torch.manual_seed(0)
    made = added(checkpoint.load(checkpoint.find("fast")), OUTDOOR.names)
    torch.nn.init.normal_(made.embed_faces.weight[:, -8:], std=0.1)
    made.save(tmp_path / "network.safetensors")
    return tmp_path / "network.safetensors"


def test_the_teacher_is_beside_the_network_and_runs_once(network, tmp_path, monkeypatch):
    """A row would be of another fabric or wind, the teacher would run when nobody asked, or again for the same scene.
    The shift of this teacher's cloth follows from its rule: 1e-4 cm of float32 positions."""
    module = types.SimpleNamespace(make=lambda device: Blown())
    monkeypatch.setitem(sys.modules, "blown_teacher", module)
    monkeypatch.setitem(TEACHERS, "blown", TeacherEntry("blown_teacher", None, (), "nobody's"))
    monkeypatch.setattr(picture, "FABRICS", dict(list(picture.FABRICS.items())[::2]))
    monkeypatch.setattr(picture, "WINDS", dict(list(picture.WINDS.items())[:2]))
    monkeypatch.setattr(picture, "SIZE", (60, 80))
    out = tmp_path / "out"
    given = ["--network", str(network), "--out", str(out), "--frames", "4"]
    picture.main(given)
    assert Blown.simulated == 0
    assert set(json.loads((out / "fabrics_and_winds.json").read_text())["shift"]) == {"network"}
    alone = (out / "fabrics_and_winds.png").stat().st_size
    for _ in range(2):
        picture.main([*given, "--teacher", "blown"])
        assert Blown.simulated == 4
    assert (out / "fabrics_and_winds.png").stat().st_size > alone
    shift = json.loads((out / "fabrics_and_winds.json").read_text())["shift"]
    for row in shift["blown"]:
        density, speed = picture.FABRICS[row["fabric"]].density, picture.WINDS[row["wind"]][0]
        assert row["shift_cm"][0] == pytest.approx(100.0 * 0.025 * speed / density, abs=1e-4)
    moved = [np.abs(row["shift_cm"]).max() for row in shift["network"] if any(picture.WINDS[row["wind"]])]
    assert min(moved) > 1e-3
