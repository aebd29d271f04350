"""The table of materials and wind: who gets which material, and what its differences say."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from support import sequences
from support.sequences import two_layers

from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.material import Material
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.evaluate.measure import EvaluateConfig, evaluate
from warpgarment.training.rollouts import predict
from warpgarment.training.tables.options import DataLacks, OptionMissing, TableOptions
from warpgarment.training.tables.outdoor.table import Case, permuted, summary

CLOTH = [Material(density=0.1 * (k + 1), bend=10.0 ** -(k + 1)) for k in range(4)]


def calm(content: dict) -> None:
    """Two layers without wind."""
    two_layers(content)
    del content["wind"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two outfits, of which one is in the wind."""
    root = tmp_path_factory.mktemp("layers")
    for number, spoil in enumerate((two_layers, calm)):
        garments = [
            {"name": f"g{k}", "category": "tube", "material": CLOTH[2 * number + k].as_dict()} for k in range(2)
        ]
        extra = {"garments": garments}
        sequences.write(root, f"s{number}", "test", seed=number, frames=16, spoil=spoil, manifest=extra)
    return root


def saved(path, outdoor=OUTDOOR.names):
    """The file of a network whose predictions depend on all its inputs."""
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(
        NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, outdoor=outdoor)
    )
    for head in (network.face_head, network.velocity_head):
        torch.nn.init.normal_(head.weight, std=1e-3)
    checkpoint.save(network, path)
    return path


@pytest.mark.parametrize("seed", range(4))
def test_no_garment_keeps_its_material(seed):
    """A garment with its own material among the shuffled ones would flatter them; one without would get one."""
    given = [[CLOTH[0], None], [CLOTH[1]], [CLOTH[2], CLOTH[3]]]
    found = permuted(given, seed)
    assert found[0][1] is None
    flat = [m for of_one in found for m in of_one if m is not None]
    assert sorted(m.density for m in flat) == [m.density for m in CLOTH]
    assert all(a is not b for a, b in zip(flat, CLOTH, strict=True))
    assert given[0][0] is CLOTH[0]
    with pytest.raises(DataLacks, match="fewer than two garments"):
        permuted([[CLOTH[0], None]], 0)


def test_figures_of_cases():
    """A mean or a difference would be of other sequences than it says. By hand, exact to rounding."""
    cases = [
        Case("a", "warm", True, 2, 5, {"right": [1.0], "other": [1.2, 1.4], "no wind": [2.0]}, {"other": [0.1, 0.3]}),
        Case("b", "warm", False, 2, 5, {"right": [3.0], "other": [2.9, 3.1]}, {"other": [0.2, 0.2]}),
        Case("c", "warm", True, 2, 5, {"right": [2.0], "other": [np.nan, 2.1], "no wind": [1.0]}, {"other": [0.9, 1]}),
    ]
    right, other, calm_air = summary(cases)
    assert right["all"]["error_cm"] == pytest.approx(2.0)
    assert other["all"]["error_cm"] == pytest.approx((1.3 + 3.0) / 2)
    assert other["all"]["more_cm"] == pytest.approx(0.15)
    assert other["all"]["standard_error_cm"] == pytest.approx(0.15)
    assert (other["all"]["larger"], other["all"]["compared"], other["all"]["failed"]) == (3, 4, 1)
    assert other["all"]["moved_cm"] == pytest.approx(0.2)
    assert other["windy"]["sequences"] == 1
    assert "all" not in calm_air
    assert calm_air["windy"]["more_cm"] == pytest.approx(0.0)
    assert calm_air["windy"]["larger"] == 1


def test_table(data, tmp_path):
    """The table would show the errors of other rollouts than those of its rows. Exact, against `predict`."""
    network = saved(tmp_path / "network.safetensors")
    config = EvaluateConfig(
        data=data, out=tmp_path / "out", network=str(network), table="outdoor", device="cpu", frames=4,
        tables=TableOptions(shuffles=2, against=("fast",)),
    )  # fmt: skip
    evaluate(config)
    assert sorted(p.name for p in config.out.iterdir()) == ["outdoor.json", "outdoor.md", "outdoor.png"]
    found = json.loads((config.out / "outdoor.json").read_text())
    names = ["right", "other materials", "no material", "no wind", "neither", "skinned", "fast"]
    rows = {(row["start"], row["variant"]): row for row in found["rows"]}
    assert set(rows) == {(start, name) for start in ("warm", "cold") for name in names}
    case = next(case for case in found["sequences"] if case["name"] == "s0" and case["start"] == "cold")
    assert (case["windy"], case["garments"], case["frames"]) == (True, 2, 4)
    sequence, simulator = Sequence.load(data / "s0"), Simulator(checkpoint.load(network), "cpu")
    truth = np.asarray(sequence.vertices[1:5], np.float64)
    expected = predict(simulator, sequence, 0, 4, cold=True)
    assert case["errors"]["right"][0] == pytest.approx(100.0 * np.linalg.norm(expected - truth, axis=-1).mean())
    assert all(case["moved"][name][0] > 0.0 for name in names[1:5])
    assert len(case["errors"]["other materials"]) == 2
    calm_one = next(case for case in found["sequences"] if case["name"] == "s1")
    assert "no wind" not in calm_one["errors"]


def test_what_cannot_be_compared(data, tmp_path):
    """A network without the channels would get a table of equal rows."""
    for options, error, message in (
        ({"network": "fast", "data": data}, DataLacks, "reads neither materials nor wind"),
        ({"network": "fast"}, OptionMissing, "--data"),
    ):
        with pytest.raises(error, match=message):
            evaluate(EvaluateConfig(**options, table="outdoor", device="cpu", out=tmp_path, picture=False))
