"""Tables whose rows are trained: one protocol and one budget for all, each row with its own change."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences
from support import tables as table_scenes
from support.tables import NETWORK, QUICK, SHAPE, table_config

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence, list_sequences
from warpgarment.training.evaluate.measure import evaluate
from warpgarment.training.rollouts import predict
from warpgarment.training.tables import compare, runs, settings, variants
from warpgarment.training.tables.options import OptionMissing
from warpgarment.training.train import start as train
from warpgarment.training.train.config import TrainConfig


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return table_scenes.small_set(tmp_path_factory.mktemp("set"))


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    """Two rows of table 2, trained for three steps each."""
    root = tmp_path_factory.mktemp("table2")
    config = table_config(data, root)
    return root, config, evaluate(config)


def test_rows_of_table_2_have_one_budget_and_their_own_attention(made):
    """Rows differ in more than the row is about: every setting but power and radius must be equal in their records, and
    both must have had their three steps."""
    root, _, result = made
    records = {n: json.loads((root / "runs/table2" / n / "row.json").read_text()) for n in ("power_1", "radius_0.3")}
    one, other = (record["settings"] for record in records.values())
    differing = {key for key in one if one[key] != other[key]}
    assert differing == {"network.geodesic_power", "network.geodesic_radius"}
    assert all(record["complete"] and record["steps"] == 3 for record in records.values())
    shapes = [checkpoint.read_metadata(root / "runs/table2" / n / "network.safetensors")[0] for n in records]
    assert [(s.geodesic_power, s.geodesic_radius) for s in shapes] == [(1.0, 0.15), (2.0, 0.3)]
    assert [row["steps"] for row in result["rows"] if row["row"] != "baselines"] == [3, 3]


def test_rows_are_measured_alike_and_written(made, data):
    """A row is measured otherwise than `evaluate` would, or a file is missing: the first row against an independent
    evaluation of its checkpoint (to 1e-9: the same computation)."""
    root, config, result = made
    file = root / "runs/table2/power_1" / json.loads((root / "runs/table2/power_1/row.json").read_text())["file"]
    alone = dataclasses.replace(config, table=None, out=root / "alone", network=str(file), picture=False)
    again = evaluate(alone)
    for start in ("warm", "cold"):
        ours = result["rows"][0]["mean"][start]["network"]
        assert ours["mean_vertex_error_cm"] == pytest.approx(
            again["mean"][start]["network"]["mean_vertex_error_cm"], rel=1e-9
        )
        baseline = result["rows"][-1]["mean"][start]["skinned"]
        assert baseline["chamfer_m2"] == pytest.approx(again["mean"][start]["skinned"]["chamfer_m2"], rel=1e-9)
    assert sorted(p.name for p in config.out.iterdir()) == ["table2.json", "table2.md", "table2.png"]
    saved = json.loads((config.out / "table2.json").read_text())
    assert [row["row"] for row in saved["rows"]] == ["power_1", "radius_0.3", "baselines"]
    text = (config.out / "table2.md").read_text()
    assert "--table table2" in text
    assert "p = 1, r = 0.15 m" in text
    assert "3 steps" in text
    assert str(root) not in text
    assert (config.out / "table2.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_complete_runs_are_not_trained_again(made, data, monkeypatch):
    """A table that is made again would cost its trainings again."""
    _, config, _ = made
    monkeypatch.setattr(runs, "train", lambda config: pytest.fail(f"trained {config.out} again"))
    again = evaluate(dataclasses.replace(config, picture=False, baselines=False))
    assert [row["row"] for row in again["rows"]] == ["power_1", "radius_0.3"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 4}, "steps was 3, is 4"),
        ({"seed": 1}, "seed was 0, is 1"),
        ({"settings": (*QUICK, "lr=0.5")}, "lr was 0.001, is 0.5"),
        ({"overrides": (*SHAPE, "layers=2")}, "network.layers was 1, is 2"),
    ],
)
def test_runs_with_other_settings_are_refused(made, monkeypatch, change, message):
    """A row with another budget, seed, training or shape would stand in the table as if it were comparable."""
    _, config, _ = made
    monkeypatch.setattr(runs, "train", lambda config: pytest.fail("trained over another run"))
    with pytest.raises(runs.RunMismatch, match=message):
        evaluate(dataclasses.replace(config, tables=dataclasses.replace(config.tables, **change)))


def test_other_data_and_foreign_folders_are_refused(made, data, tmp_path, monkeypatch):
    """Rows trained on different data, by hand, or whose network was exchanged, would stand side by side."""
    root, config, _ = made
    monkeypatch.setattr(runs, "train", lambda config: pytest.fail("trained over another run"))
    other = synthetic_sequences.write_set(tmp_path / "other", train=1, frames=14)
    with pytest.raises(runs.RunMismatch, match="data train was 2, is 1"):
        evaluate(dataclasses.replace(config, data=other))
    training = compare.plan(config)[0]["power_1"]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "best.safetensors").write_bytes(b"")
    with pytest.raises(runs.RunMismatch, match="did not start it"):
        runs.trained(tmp_path / "foreign", training, runs.identity(data))
    folder = root / "runs/table2/power_1"
    record = json.loads((folder / "row.json").read_text())
    (tmp_path / "changed").mkdir()
    (tmp_path / "changed" / "row.json").write_text(json.dumps(record))
    theirs = root / "runs/table2/radius_0.3/network.safetensors"
    (tmp_path / "changed" / record["file"]).write_bytes(theirs.read_bytes())
    with pytest.raises(runs.RunMismatch, match="another than"):
        runs.trained(tmp_path / "changed", training, runs.identity(data))


def test_an_interrupted_row_goes_on_to_the_same_network(made, data, tmp_path, monkeypatch):
    """A resumed row starts anew, or ends as another network than one trained in one go: weights must be equal, bit for
    bit, to those of the fixture, which was not interrupted."""
    root, config, _ = made
    training = compare.plan(config)[0]["power_1"]
    folder = tmp_path / "row"

    with monkeypatch.context() as patch:  # stops in the third step, after the state of the second was saved
        update = train.Run.update

        def stopping(self, batch):
            if self.step == 2:
                raise KeyboardInterrupt
            return update(self, batch)

        patch.setattr(train.Run, "update", stopping)
        with pytest.raises(KeyboardInterrupt):
            runs.trained(folder, training, runs.identity(data))
    assert json.loads((folder / "row.json").read_text())["complete"] is False
    assert (folder / "state.safetensors").exists()
    run = runs.trained(folder, training, runs.identity(data))
    assert run.steps == 3
    ours, theirs = (
        checkpoint.load(f / "network.safetensors").state_dict() for f in (folder, root / "runs/table2/power_1")
    )
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_rows_of_table_1_change_what_they_say():
    """A row leaves in what it claims to leave out: heads, loss term and the replacement of singular values."""
    common = TrainConfig(data=Path("d"), out=Path("o"), steps=1)
    rows = {row.name: row for row in variants.table1()}
    assert list(rows) == ["without_manifold_heads", "without_singular_values", "full"]
    bare = rows["without_manifold_heads"].of(common)
    assert (bare.network_config().manifold_heads, common.network_config().manifold_heads) == (0, 2)
    counts = [ManifoldAwareTransformer(c.network_config()).parameter_count() for c in (bare, common)]
    assert counts[0] == counts[1]
    no_values = rows["without_singular_values"].of(common)
    assert no_values.loss.singular_values == 0.0
    assert no_values.network_config() == dataclasses.replace(common.network_config(), replace_singular_values=False)
    assert rows["full"].of(common) == common


def test_without_singular_values_predicted_ones_change_nothing(data):
    """The row of table 1 still uses predicted singular values: a network whose prediction of them is off by a half must
    give the rollout of one whose is not, bit for bit; with them, faces come out half as large again."""
    sequence = Sequence.load(list_sequences(data, split="test")[0])
    moved = {}
    for replaced in (False, True):
        shape = dataclasses.replace(NETWORK, replace_singular_values=replaced)
        for off in (0.0, 0.5):
            torch.manual_seed(0)
            network = ManifoldAwareTransformer(shape)
            network.singular_value_mean += off
            simulator = Simulator(network, "cpu", collision_passes=0)
            moved[replaced, off] = predict(simulator, sequence, 0, 3, cold=True)
    np.testing.assert_array_equal(moved[False, 0.0], moved[False, 0.5])
    sizes = [np.ptp(moved[True, off][-1], axis=0).max() for off in (0.0, 0.5)]
    assert sizes[1] > 1.2 * sizes[0]  # not quite half: pins hold part of it


def test_rows_of_table_2_cover_the_papers_powers():
    """A power of the paper's table 2 is missing, or the network as given stands there twice."""
    rows = variants.table2(NetworkConfig.base())
    powers = [dict(row.value)["power"] for row in rows if "power" in dict(row.value)]
    assert powers == [0.01, 0.1, 1, 10, 20, 50, 100]
    assert [row.name for row in rows].count("as_given") == 1
    assert {dict(row.value).get("radius") for row in rows} >= {0.05, 0.15, 0.3, 0.6, 1.0}
    small = variants.table2(NetworkConfig.small())
    assert {dict(row.value).get("power") for row in small} >= {*powers, 2.0}


def test_plans_that_cannot_be_are_refused(data, tmp_path):
    """Hours of training on a table with no budget, two budgets, equal rows or misspelt settings."""
    for change, message in (
        ({"steps": None}, "--steps N or --time-limit"),
        ({"time_limit": 1.0}, "--steps N or --time-limit"),
    ):
        with pytest.raises(OptionMissing, match=message):
            compare.plan(table_config(data, tmp_path, **change))
    with pytest.raises(OptionMissing, match="small, base, fast"):
        compare.plan(dataclasses.replace(table_config(data, tmp_path), network="elsewhere.safetensors"))
    with pytest.raises(variants.RowError, match="no rows power_7"):
        compare.plan(table_config(data, tmp_path, rows=("power_7",)))
    headless = table_config(data, tmp_path, "table1", rows=("full", "without_manifold_heads"))
    tables = dataclasses.replace(headless.tables, overrides=(*SHAPE, "manifold_heads=0"))
    with pytest.raises(variants.RowError, match="without_manifold_heads and full would be the same"):
        compare.plan(dataclasses.replace(headless, tables=tables))
    with pytest.raises(variants.RowError, match="no network setting 'laiers'"):
        compare.plan(table_config(data, tmp_path, overrides=("laiers=2",)))
    for text, message in (
        ("lrr=1", "no setting 'lrr'"),
        ("lr=fast", "must be float"),
        ("noise=1", "a group"),
        ("steps=9", "an option of its own"),
        ("batch_size", "name=value"),
        ("loss.velocity=true", "must be float"),
    ):
        with pytest.raises(settings.SettingError, match=message):
            compare.plan(table_config(data, tmp_path, settings=(text,)))
    changed = settings.with_settings(TrainConfig(data=data, out=tmp_path, steps=1), ("noise.position=0.5", "lr=1"))
    assert (changed.noise.position, changed.lr) == (0.5, 1)
