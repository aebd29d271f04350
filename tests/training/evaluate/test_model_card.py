"""The page about a network: its figures are those of the evaluation, and what it shows is what the rule says."""

from __future__ import annotations

import json
import math
import re

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.evaluate import measure as evaluate
from warpgarment.training.evaluate import model_card, model_card_pictures
from warpgarment.training.evaluate.model_card import CardError, ModelCardConfig, chosen, largest, read_log, write_card


def row(name, network, skinned, start="cold", **entries):
    """A row of an evaluation; a network error of None is a rollout that failed."""
    return {
        "sequence": name,
        "start": start,
        "network": {"mean_vertex_error_cm": network, "finite": network is not None},
        "skinned": {"mean_vertex_error_cm": skinned, "finite": True},
    } | entries


def test_choice():
    """Pictures would show what looks good. Ratios by hand: b 0.5, d 0.8, a 1, e 1 (a before e), c failed; warm ones
    do not count."""
    rows = [row("a", 2.0, 2.0), row("b", 1.0, 2.0), row("c", None, 2.0), row("d", 4.0, 5.0), row("e", 3.0, 3.0)]
    cases = chosen([row("x", 0.1, 2.0, "warm"), *rows, row("b", 9.0, 2.0, "warm")])
    assert [(case.role, case.row["sequence"]) for case in cases] == [
        ("best", "b"), ("median", "a"), ("second worst", "e"), ("worst", "c"),
    ]  # fmt: skip
    assert [case.ratio for case in cases] == [0.5, 1.0, 1.0, math.inf]
    assert [case.row["sequence"] for case in chosen(rows[:4])] == ["b", "d", "a", "c"]


def test_choice_among_few():
    """A set of one or two sequences would be drawn twice, or not at all."""
    one, two = [row("a", 1.0, 2.0)], [row("a", 1.0, 2.0), row("b", 1.0, 1.5)]
    assert [(c.role, c.file) for c in chosen(one)] == [("best, median, second worst, worst", "best.png")]
    assert [(c.role, c.file) for c in chosen(two)] == [
        ("best, median, second worst", "best.png"), ("worst", "worst.png"),
    ]  # fmt: skip


def test_frames_of_largest_error():
    """Frames side by side, or of small error, would be drawn. By hand."""
    assert largest(np.array([1.0, 5, 6, 4, 0, 3, 2, 9]), 3, 3) == [2, 7]
    assert largest(np.array([1.0, 5, 6, 4, 0, 3, 2, 9]), 2, 1) == [2, 7]
    assert largest(np.array([1.0, 2, np.nan, np.inf]), 3, 1) == [0, 1]
    assert largest(np.full(4, np.nan), 2, 1) == []


def test_log_of_a_resumed_run(tmp_path):
    """A curve would run back and forth, or a run that was killed while writing would have none."""
    lines = [
        {"step": 20, "loss": 3.0},
        {"step": 40, "loss": 2.0},
        {"step": 40, "rollout_error_cm": "inf"},
        {"step": 40, "pool_rollouts": 2},
        {"step": 40, "loss": 2.5},
        {"step": 60, "loss": 1.0},
        {"step": 60, "rollout_error_cm": 1.5},
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(map(json.dumps, lines)) + '\n{"step": 80, "lo')
    found = read_log(tmp_path / "log.jsonl")
    assert [(line["step"], line["loss"]) for line in found if "loss" in line] == [(20, 3.0), (40, 2.5), (60, 1.0)]
    errors = [(line["step"], line["rollout_error_cm"]) for line in found if "rollout_error_cm" in line]
    assert errors == [(40, "inf"), (60, 1.5)]
    assert model_card_pictures.curves(tmp_path / "a.png", found)
    assert iio.imread(tmp_path / "a.png").shape[1] > iio.imread(tmp_path / "a.png").shape[0]
    assert not model_card_pictures.curves(tmp_path / "b.png", [{"step": 1, "rollout_error_cm": "inf"}])
    assert not (tmp_path / "b.png").exists()


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Two sequences, a tiny network with notes and a log, and its evaluation."""
    root = tmp_path_factory.mktemp("card")
    for number, category in enumerate(["sleeve", "tube"]):
        manifest = {"category": category, "motion": f"procedural:{number}"}
        settings = {"frames": 6, "seed": number, "around": 8, "rings": 4}
        synthetic_sequences.write(root / "data", f"s{number}", "test", manifest=manifest, **settings)
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(
        NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, manifold_heads=1, history=3)
    )
    notes = {"steps": 1234, "hours": 0.25, "training": {"lr": 0.001}}
    checkpoint.save(network, root / "run" / "best.safetensors", notes=notes)
    log = [{"step": 20, "loss": 3.0}, {"step": 40, "loss": 2.0}, {"step": 40, "rollout_error_cm": 1.25}]
    (root / "run" / "log.jsonl").write_text("\n".join(map(json.dumps, log)))
    evaluate.evaluate(
        evaluate.EvaluateConfig(
            data=root / "data",
            out=root / "evaluation",
            network=str(root / "run"),
            geodesic_frames=1,
            device="cpu",
            picture=False,
        )
    )
    return root


def config(root, out, **changes):
    """Settings of a small page."""
    settings = {
        "data": root / "data",
        "network": str(root / "run"),
        "evaluation": root / "evaluation" / "evaluation.json",
        "out": out,
        "moments": 2,
        "device": "cpu",
        "size": (48, 64),
    }
    return ModelCardConfig(**(settings | changes))


def edited(root, path, change):
    """A copy of the evaluation that `change` has edited."""
    result = json.loads((root / "evaluation" / "evaluation.json").read_text())
    change(result)
    path.write_text(json.dumps(result))
    return path


def cold(result, name):
    """The row of a cold start."""
    return next(r for r in result["sequences"] if r["sequence"] == name and r["start"] == "cold")


def test_page(evaluated, tmp_path):
    """Figures, choice or frames on the page would be others than those measured. Errors of frames are computed here,
    from a rollout of the public simulator, to the printed digits."""
    text = write_card(config(evaluated, tmp_path, size=(190, 260))).read_text()
    result = json.loads((evaluated / "evaluation" / "evaluation.json").read_text())
    for start in ("warm", "cold"):
        error = result["mean"][start]["network"]["mean_vertex_error_cm"]
        assert f"| {start} | network | {error:.2f} |" in text
    for category, name in (("sleeve", "s0"), ("tube", "s1")):
        shown = " | ".join(f"{cold(result, name)[m]['mean_vertex_error_cm']:.2f}" for m in evaluate.METHODS)
        assert f"| {category} | cold | 1 | {shown} |" in text
    assert "| steps | 1234 |" in text
    assert "Least validation error: 1.25 cm, at step 40." in text
    assert model_card.RULE in text
    assert "does not say what it was trained on" in text
    ratios = {
        name: cold(result, name)["network"]["mean_vertex_error_cm"]
        / cold(result, name)["skinned"]["mean_vertex_error_cm"]
        for name in ("s0", "s1")
    }
    worst = max(ratios, key=ratios.get)
    assert f"on {sum(r < 1 for r in ratios.values())} of 2 sequences; on 0 its rollout failed" in text
    line = next(line for line in text.splitlines() if line.startswith("**Worst**"))
    assert f"{worst}, " in line
    assert f"ratio {ratios[worst]:.2f}." in line

    sequence = Sequence.load(evaluated / "data" / worst)
    simulator = Simulator(checkpoint.load(evaluated / "run"), "cpu")
    body = sequence.body()
    moved = simulator.rollout(
        sequence.garment, BodyMotion(body.vertices, body.faces, 30.0), first_vertices=sequence.vertices[0]
    ).vertices
    errors = 100 * np.sqrt(((moved - sequence.vertices) ** 2).sum(-1)).mean(1)
    drawn = re.findall(r"(\d+) \(([\d.]+) cm\)", line)
    assert drawn == [(str(errors.argmax()), f"{errors.max():.1f}")]  # 6 frames are less than half a second

    assert "Rolled out again" not in text
    pictures = set(re.findall(r"\]\((card/\w+\.png)\)", text))
    assert pictures == {"card/best.png", "card/worst.png", "card/training.png"}
    assert {f"card/{p.name}" for p in (tmp_path / "card").iterdir()} == pictures
    for name in pictures:
        assert (tmp_path / name).stat().st_size < 400_000
    image = iio.imread(tmp_path / "card" / "worst.png").astype(int)
    assert image.shape[1] == 190
    middle = image.shape[0] - 260
    red, blue = image[middle - 260 : middle], image[middle:]  # network above, teacher below
    assert (red[..., 0] - red[..., 2]).max() > 60 > 40 > (blue[..., 0] - blue[..., 2]).max()


def test_failures_are_shown(evaluated, tmp_path, monkeypatch):
    """A network that fails would look better than one that is bad: a failed rollout is the worst."""

    def fails(simulator, sequence, newest, steps, *, cold):
        moved = np.array(sequence.vertices[newest + 1 : newest + steps + 1])
        moved[0] += np.array([0.03, 0.0, 0.04], np.float32)  # 5 cm
        moved[2:] = np.nan
        return moved

    def change(result):
        cold(result, "s0")["network"].update(mean_vertex_error_cm=None, finite=False)

    path = edited(evaluated, tmp_path / "e.json", change)
    monkeypatch.setattr(model_card, "predict", fails)
    text = write_card(config(evaluated, tmp_path, evaluation=path)).read_text()
    assert "**Worst**: s0, sleeve, procedural:0. Network failed, skinned" in text
    assert "ratio inf. Frames 1 (5.0 cm)." in text
    assert "on 1 its rollout failed" in text
    assert "| sleeve | cold | 1 | - (1 failed) |" in text
    assert text.count("Rolled out again for the picture") == 1  # the other one failed now, and had not before


def test_another_rollout_is_admitted(evaluated, tmp_path):
    """A picture of a rollout that is not the one measured would pass for it."""

    def change(result):
        cold(result, "s0")["network"]["mean_vertex_error_cm"] *= 1.2

    text = write_card(
        config(evaluated, tmp_path, evaluation=edited(evaluated, tmp_path / "e.json", change))
    ).read_text()
    assert text.count("Rolled out again for the picture; when it was evaluated it gave") == 1


def test_pictures_stay_small(evaluated, tmp_path, monkeypatch):
    """A page would grow by megabytes."""
    write_card(config(evaluated, tmp_path / "a"))
    size = (tmp_path / "a" / "card" / "worst.png").stat().st_size
    monkeypatch.setattr(model_card_pictures, "LARGEST", size - 1)
    write_card(config(evaluated, tmp_path / "b"))
    assert 0 < (tmp_path / "b" / "card" / "worst.png").stat().st_size < size


def without_baselines(result):
    for found in result["sequences"]:
        del found["skinned"]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda r: r["network"]["config"].update(layers=7), "is of another network"),
        (lambda r: r["network"]["notes"].update(steps=1), "is of another network"),
        (without_baselines, "with baselines"),
        (lambda r: r.update(sequences=[]), "no cold starts"),
        (lambda r: r.pop("mean"), "no result of an evaluation"),
        (lambda r: [f.update(sequence="gone") for f in r["sequences"]], "has no sequence gone"),
        (lambda r: [f.update(frames=99) for f in r["sequences"]], "has 6 frames, 100 were evaluated"),
    ],
)
def test_what_does_not_belong_together(evaluated, tmp_path, change, word):
    """A page would give one network's figures with another's pictures, or half a page would be left."""
    path = edited(evaluated, tmp_path / "e.json", change)
    with pytest.raises(CardError, match=word):
        write_card(config(evaluated, tmp_path / "out", evaluation=path))
    assert not list((tmp_path / "out").rglob("*.*"))


def test_an_evaluation_from_before_a_setting_came(evaluated, tmp_path):
    """Evaluations written by earlier versions would be said to be of another network: settings that came since have
    their defaults in them."""
    path = edited(evaluated, tmp_path / "e.json", lambda r: r["network"]["config"].pop("replace_singular_values"))
    settings, notes = checkpoint.read_metadata(checkpoint.find(config(evaluated, tmp_path).network))
    assert model_card.read_evaluation(path, settings.as_dict(), notes)["sequences"]
    with pytest.raises(CardError, match="is of another network"):
        model_card.read_evaluation(path, settings.as_dict() | {"replace_singular_values": False}, notes)


def test_files_that_are_missing(evaluated, tmp_path):
    """An evaluation or a log that is not there would end in a stack trace."""
    with pytest.raises(CardError, match=r"none\.json: no result"):
        write_card(config(evaluated, tmp_path, evaluation=tmp_path / "none.json"))
    with pytest.raises(CardError, match=r"none\.jsonl: no such file"):
        write_card(config(evaluated, tmp_path, log=tmp_path / "none.jsonl"))
