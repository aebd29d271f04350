"""`python -m benchmarks`: every part on a tiny garment, and counts compared with ones made by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh

from benchmarks import exact, manifold, roofline
from benchmarks.__main__ import SECONDS, main
from benchmarks.measure import aimed_time, compared, interleaved
from benchmarks.networks import named
from warpgarment.errors import CheckpointError
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer

EXPECTED = {  # part: what its rows must be about, and references beside them
    "geodesics": ({"geodesics of all pairs of faces", "geodesics, off the exact ones"}, set()),
    "stages": (
        {
            "deformation gradients",
            "replace singular values",
            "signed distance, refit included",
            "contact query, within 4 mm",
            "depth query, inside only",
        }
        | {"features of a frame, one launch", "features other than distance", "collisions, off the minimiser"}
        | {"Poisson solve", "Poisson solve, off the direct solution", "collisions, 4 passes"}
        | {"manifold heads of a layer", "manifold heads of a layer, patches", "manifold heads of a layer, pooled"}
        | {f"weights of {name}, pooled at 4,096 centres, off the dense ones" for name in ("base", "small")},
        {"NumPy", "NumPy SVD", "libigl fast winding number", "building it anew", "in two launches", "dense softmax"}
        | {"SciPy splu prefactored", "CHOLMOD prefactored", "cholespy prefactored", "CHOLMOD every frame"}
        | {"SciPy splu every frame", "SciPy splu, symmetric, every frame"},
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
    """A part would end without its files, omit a reference without a note, or leave a figure out."""
    monkeypatch.setitem(SECONDS, True, 0.01)
    monkeypatch.setitem(roofline.MATRIX, "cpu", 64)
    monkeypatch.setattr(manifold, "POOLED_FROM", 100)
    monkeypatch.setitem(roofline.COPIED, "cpu", 2**16)
    options = ["--quick", "--faces", "150", "--batch", "1", "2", "--device", "cpu", "--network", "small", "fast"]
    main(["--only", part, *options, "--out", str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cpu.json", "cpu.md", "cpu.png"]
    written = json.loads((tmp_path / "cpu.json").read_text())
    rows = written["rows"]
    about, references = EXPECTED[part]
    networks = [label for label, _ in named(["small", "fast"])]
    assert about <= {row["what"] for row in rows}
    assert references == {row["reference"] for row in rows if "reference" in row}
    for row in rows:
        assert row["part"] == part
        assert "note" in row or {"rate", "median_ms", "warp_launches", "reached"} & row.keys(), row
        assert ("target" in row) == ("met" in row) == ("reached" in row)
        if "ratio" in row:
            assert row["ratio"] == row["reference_min_ms"] / row["min_ms"]
            assert 0 < row["min_ms"] <= row["median_ms"]
        if part in ("batch", "roofline", "teacher", "profile") and "note" not in row and "device: " not in row["what"]:
            assert row["network"] in networks
    if part in ("batch", "roofline", "teacher", "profile"):
        assert {row["network"] for row in rows if "network" in row} == set(networks)
    if part in ("batch", "roofline", "profile"):
        assert any("needs a GPU" in row.get("note", "") for row in rows)
    table = (tmp_path / "cpu.md").read_text()
    assert {"torch threads", "warp-lang", "device"} <= set(written["machine"])
    assert all(row["what"] in table for row in rows if not row["what"].startswith("device: "))


def test_network_bytes():
    """The roofline would be wrong. By hand, for one layer without manifold heads: bytes of every operator.

    E = 8, W = 16, T = 3 + 1 tokens, in units of numbers: two norms read and write 4 E T, q, k, v read E and write 3 E,
    attention reads 3 E and writes E, the output 2 E, two sums 3 E each, the feed-forward 2 E and the hidden layer
    written, read, written by its activation and read: 4 W. Two frames of history of 34 float32 features a face.
    """
    config = NetworkConfig(embedding=8, layers=1, feed_forward=16, heads=2, manifold_heads=0, history=2)
    parameters = ManifoldAwareTransformer(config).parameter_count()
    numbers = 4 * (8 * (4 + 4 + 4 + 2 + 6 + 2) + 4 * 16) + parameters
    assert roofline.network_bytes(config, 3, 1, 1, parameters, 4) == 4 * numbers + 4 * 2 * 34 * 3


def test_network_bytes_of_patches():
    """The roofline of a network of patches would be wrong.

    By hand, for 2 patches of 5 faces, F = 4, G = 6, K = 1, and the layer of the test above on 2 + 1 tokens.

    A face, in numbers: embedded F; before: norm 2 F, F + G, 2 G, G + F, sum 3 F; pooled F; spread F, sum 3 F; after
    likewise with neighbours read and written 2 F, F + G and a sum of hidden layers 3 G; norm 2 F, answer F + 12. A
    patch: written F, F + E, difference 3 E, E + F. Indices are int64, their shares float32: 4 of each for pooling and
    again for spreading, and 3 neighbours.
    """
    config = NetworkConfig.fast(
        embedding=8, layers=1, feed_forward=16, heads=2, manifold_heads=0, history=2, face_layers=1, face_embedding=4,
        face_feed_forward=6,
    )  # fmt: skip
    parameters, f, g, e = build_network(config).parameter_count(), 4, 6, 8
    before = 2 * f + (f + g) + 2 * g + (g + f) + 3 * f
    face = f + before + f + 4 * f + before + (2 * f + (f + g) + 3 * g) + 2 * f + f + 12
    patch = f + (f + e) + 3 * e + (e + f)
    numbers = 3 * (e * 22 + 4 * 16) + 5 * face + 2 * patch + parameters
    expected = 4 * numbers + 4 * 2 * 34 * 5 + 5 * (2 * 4 * (8 + 4) + 3 * 8)
    assert roofline.network_bytes(config, 5, 1, 1, parameters, 4, 2) == expected


def test_calls_take_turns():
    """A machine that is busy for a while would slow one side of a comparison only."""
    order = []
    times = interleaved({k: lambda k=k: order.append(k) for k in "ab"}, torch.device("cpu"), 0.01)
    assert order == ["a", "b"] * (len(order) // 2)
    assert len(times["a"]) == len(times["b"]) == len(order) // 2 - 1  # the first of each warms up
    row = compared({"what": "x"}, lambda: None, {"other": "not installed"}, torch.device("cpu"), 0.01)
    assert row[-1] == {"what": "x", "reference": "other", "note": "not installed"}
    assert "min_ms" in row[0]
    rows = compared({"what": "x"}, {"y": int, "z": int}, {"w": int, "v": "none"}, torch.device("cpu"), 0.01)
    assert [(row["what"], row["reference"]) for row in rows] == [("y", "w"), ("y", "v"), ("z", "w"), ("z", "v")]


def test_targets_are_scaled_to_their_faces():
    """A target for 2,000 faces would be met by a smaller garment. 31 ms at 1,836 faces are 33.8 at 2,000."""
    row = aimed_time({"faces": 1836, "median_ms": 31.0}, 33.0, 2000)
    assert not row["met"]
    assert row["reached"] == "33.8 ms, scaled from 1,836 faces"
    assert aimed_time({"faces": 1836, "median_ms": 30.0}, 33.0, 2000)["met"]
    assert not aimed_time({"faces": 500, "median_ms": 6.0}, 11.0, 1000, 2.0)["met"]


def test_exact_distances():
    """Accuracies would be measured against something wrong. A cube of side 2 with an inner wall, by hand: 1e-12.

    The points: outside a face, an edge and a corner; inside near a face; and within a part that is covered twice.
    """
    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    points = np.array([[1.5, 0.2, 0.1], [2.0, 2.0, 0.0], [2.0, 2.0, 2.0], [0.9, 0.3, -0.2], [0.0, 0.0, 0.9]])
    expected = [0.5, np.sqrt(2.0), np.sqrt(3.0), -0.1, -0.1]
    np.testing.assert_allclose(exact.signed_distance(points, cube.vertices, cube.faces), expected, atol=1e-12)
    inner = trimesh.creation.box((1.0, 1.0, 1.0))
    both = trimesh.util.concatenate([cube, inner])
    found = exact.signed_distance(np.array([[0.0, 0.0, 0.4]]), both.vertices, both.faces)
    np.testing.assert_allclose(found, [-0.1], atol=1e-12)  # covered twice is inside, as a limb within a body is


def test_networks_by_name(tmp_path):
    """Rows would name another network than was timed, or a name that is wrong would pass for an untrained one."""
    (label, network), (other, fast) = named(["base", "fast"])
    assert network.config == NetworkConfig.base()
    assert fast.config.architecture == "patches"
    assert label.startswith("base") and other.startswith("fast")  # noqa: PT018
    file = tmp_path / "mine.safetensors"
    checkpoint.save(ManifoldAwareTransformer(NetworkConfig.small(layers=1)), file)
    assert named([str(file)])[0].network.config.layers == 1
    with pytest.raises(CheckpointError, match="smal"):
        named(["smal"])
