"""Bad sequences among those that are evaluated: skipped, counted, with a reason, never fatal, never silent."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from support import sequences as synthetic_sequences

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.training.evaluate.measure import EvaluateConfig, NoTestData, evaluate
from warpgarment.training.tables import groups, runs
from warpgarment.training.tables.options import TableOptions

BAD = {"broken": b'{"status": "go', "list": b"[]", "text": b"\xff\xfe not a text"}


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> str:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("network") / "random.safetensors"
    shape = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2)
    checkpoint.save(ManifoldAwareTransformer(shape), path)
    return str(path)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Good sequences, some whose manifest cannot be read, and one that has none."""
    root = tmp_path_factory.mktemp("bad") / "set"
    body = {"body": {"kind": "anny"}}
    for name, split, entries in (
        ("a", "train", body | {"category": "dress", "parameters": {"cut": 0}}),
        ("b", "test", body | {"category": "dress", "parameters": {"cut": 1}}),
        ("c", "test", {"body": {"kind": "wooden"}, "category": "skirt", "parameters": "none"}),
        ("d", "test", body | {"category": ["dress"], "parameters": {"cut": [1]}}),
    ):
        synthetic_sequences.write(root, name, split, frames=13, seed=ord(name), manifest=entries)
    for name, content in BAD.items():
        (synthetic_sequences.write(root, name, "test", frames=13) / "manifest.json").write_bytes(content)
    (synthetic_sequences.write(root, "bare", "test", frames=13) / "manifest.json").unlink()
    synthetic_sequences.write(root, "brief", "test", frames=5)
    (root / "pictures").mkdir()  # no sequence, and nobody said it was
    return root


def config_for(root: Path, out: Path, network: str, **options) -> EvaluateConfig:
    base = {"frames": 2, "geodesic_frames": 1, "baselines": False, "picture": False, "device": "cpu"}
    return EvaluateConfig(data=root, out=out, network=network, **(base | options))


def check_report(folder: Path, name: str, reasons: dict[str, str]) -> None:
    """JSON and Markdown both say how many were skipped, which, and why."""
    saved = json.loads((folder / f"{name}.json").read_text())
    text = (folder / f"{name}.md").read_text()
    assert set(saved["skipped"]) == set(reasons)
    assert saved["skipped_count"] == len(reasons)
    assert f"{len(reasons)} sequences skipped:" in text
    for sequence, reason in reasons.items():
        assert reason in saved["skipped"][sequence]
        assert f"- {sequence}: {saved['skipped'][sequence]}" in text


REASONS = dict.fromkeys((*BAD, "bare"), "manifest.json") | {"brief": "5 frames", "d": "category"}


def test_an_evaluation_goes_on_without_what_it_cannot_read(root, network, tmp_path):
    """One manifest that cannot be read ends an evaluation of hundreds, or its sequence disappears without a word."""
    result = evaluate(config_for(root, tmp_path, network))
    assert {row["sequence"] for row in result["sequences"]} == {"b", "c"}
    check_report(tmp_path, "evaluation", REASONS)


def test_tables_go_on_without_what_they_cannot_read(root, network, tmp_path):
    """As above, for a table of groups, which read manifests of all splits, and for one of rollouts."""
    result = evaluate(config_for(root, tmp_path, network, table="figure12"))
    assert {row["row"] for row in result["rows"]} == {"seen", "wooden"}
    assert list(result["left_out"]) == ["capsule, never seen"]  # of which `brief` is the only one
    check_report(tmp_path, "figure12", REASONS)
    tables = TableOptions(long_frames=12, garments=())
    evaluate(config_for(root, tmp_path, network, table="long", tables=tables, max_sequences=9))
    check_report(tmp_path, "long", REASONS | {"brief": "5 recorded frames"})


def test_odd_entries_of_manifests_are_no_cuts(root):
    """A manifest whose parameters are something else than a table, or whose cut is no number, ends figure 9."""
    found = groups.cuts(root, None, {})
    assert {group.name: [f.name for f in group.folders] for group in found} == {
        "unseen_cuts": ["b"], "training_sequences": ["a"],
    }  # fmt: skip


def test_the_identity_of_data_is_that_of_what_is_trained_on(root):
    """Tables that train would stop at a manifest that training skips."""
    assert runs.identity(root)["train"] == 1


def test_reasons_stand_in_the_error_where_nothing_is_left(root, network, tmp_path):
    """The message says that there is nothing, and not that it could not be read."""
    with pytest.raises(NoTestData, match=r"manifest\.json"):
        evaluate(config_for(root, tmp_path, network, split="nowhere"))
