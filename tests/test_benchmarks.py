"""`python -m benchmarks`, every part on a tiny garment, and what it counts by hand."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks import roofline
from benchmarks.__main__ import SECONDS, main
from benchmarks.measure import compared, interleaved
from warpgarment.network import ManifoldAwareTransformer, NetworkConfig

EXPECTED = {  # part: what its rows must be about, and references beside them
    "stages": (
        {
            "deformation gradients",
            "replace singular values",
            "signed distance, refit included",
            "Poisson solve, warm start",
        }
        | {"features other than distance", "manifold heads of a layer"},
        {"NumPy", "NumPy SVD", "libigl fast winding number", "SciPy splu prefactored", "CHOLMOD prefactored"}
        | {"cholespy prefactored", "SciPy splu factored every frame", "CHOLMOD factored every frame", "dense softmax"},
    ),
    "batch": (
        {"frame per garment", "stage of a frame: network", "stage of a frame: collision"},
        {"Python loop over garments"},
    ),
    "roofline": (
        {"device: float32, operations per second", "device: bfloat16, operations per second"}
        | {"device: copy, bytes per second", "network, float32", "network, bfloat16"},
        set(),
    ),
    "teacher": ({"whole frame"}, {"Newton VBD, 10 substeps of 5 iterations"}),
    "profile": (
        {"one frame, counted", "frames without a graph, profiled", "frames as a CUDA graph, profiled"},
        set(),
    ),
}


@pytest.mark.parametrize("part", EXPECTED)
def test_each_part_writes_its_rows(part, tmp_path, monkeypatch):
    """A part would end without its files, lose a yardstick without a word, or leave a figure out."""
    monkeypatch.setitem(SECONDS, True, 0.01)
    monkeypatch.setitem(roofline.MATRIX, "cpu", 64)
    monkeypatch.setitem(roofline.COPIED, "cpu", 2**16)
    options = ["--quick", "--faces", "150", "--batch", "1", "2", "--device", "cpu", "--weights", "small"]
    main(["--only", part, *options, "--out", str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cpu.json", "cpu.md", "cpu.png"]
    written = json.loads((tmp_path / "cpu.json").read_text())
    rows = written["rows"]
    about, references = EXPECTED[part]
    assert about <= {row["what"] for row in rows}
    assert references == {row["reference"] for row in rows if "reference" in row}
    for row in rows:
        assert row["part"] == part
        assert "note" in row or row.get("rate") or row.get("median_ms") or row.get("warp_launches"), row
        if "ratio" in row:
            assert row["ratio"] == row["reference_min_ms"] / row["min_ms"]
            assert 0 < row["min_ms"] <= row["median_ms"]
    if part in ("batch", "roofline", "profile"):
        assert any("needs a GPU" in row.get("note", "") for row in rows)
    table = (tmp_path / "cpu.md").read_text()
    assert {"torch threads", "warp-lang", "device"} <= set(written["machine"])
    assert all(row["what"] in table for row in rows if not row["what"].startswith("device: "))


def test_network_bytes():
    """The roofline would lie. By hand, for one layer without manifold heads: bytes of every operator.

    E = 8, W = 16, T = 3 + 1 tokens, in units of numbers: two norms read and write 4 E T, q, k, v read E and write 3 E,
    attention reads 3 E and writes E, the output 2 E, two sums 3 E each, the feed-forward 2 E and the hidden layer
    written, read, written by its activation and read: 4 W. Two frames of history of 34 float32 features a face.
    """
    config = NetworkConfig(embedding=8, layers=1, feed_forward=16, heads=2, manifold_heads=0, history=2)
    parameters = ManifoldAwareTransformer(config).parameter_count()
    numbers = 4 * (8 * (4 + 4 + 4 + 2 + 6 + 2) + 4 * 16) + parameters
    assert roofline.network_bytes(config, 3, 1, 1, parameters, 4) == 4 * numbers + 4 * 2 * 34 * 3


def test_calls_take_turns():
    """A machine that is busy for a while would slow one side of a comparison only."""
    order = []
    times = interleaved({k: lambda k=k: order.append(k) for k in "ab"}, torch.device("cpu"), 0.01)
    assert order == ["a", "b"] * (len(order) // 2)
    assert len(times["a"]) == len(times["b"]) == len(order) // 2 - 1  # the first of each warms up
    row = compared({"what": "x"}, lambda: None, {"other": "not installed"}, torch.device("cpu"), 0.01)
    assert row[-1] == {"what": "x", "reference": "other", "note": "not installed"}
    assert "min_ms" in row[0]
