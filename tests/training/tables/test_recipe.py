"""The table of the recipe: rows that change what they say and nothing else, and a verdict that follows from them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support import sequences as synthetic_sequences

from warpgarment.training.evaluate.measure import EvaluateConfig, evaluate
from warpgarment.training.tables import compare, recipe, report, runs, settings, variants
from warpgarment.training.tables.options import TableOptions
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.run import NonFiniteLoss
from warpgarment.training.train.unrolled_objective import UnrollConfig

SHAPE = ("dropout=0.0", "embedding=16", "layers=1", "feed_forward=16", "heads=2", "manifold_heads=1")
QUICK = (
    "batch_size=2", "validate_frames=4", "validate_sequences=1", "statistics_batches=2", "ahead=0",
    "pushforward.every=2", "pushforward.rollouts=1", "pushforward.steps=2", "pushforward.share=0.25", "save_every=2",
    "validate_every=2", "log_every=1",
)  # fmt: skip
ROWS = ("as_given", "paper", "lr_third", "lr_triple")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return synthetic_sequences.write_set(tmp_path_factory.mktemp("set") / "sequences", train=2, frames=14, pins=4)


def config_for(data: Path, root: Path, **options) -> EvaluateConfig:
    tables = TableOptions(
        **({"runs": root / "runs", "steps": 3, "overrides": SHAPE, "settings": QUICK, "rows": ROWS} | options)
    )
    return EvaluateConfig(
        data=data, out=root / "out", table="recipe", tables=tables, device="cpu", frames=3, geodesic_frames=1
    )


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    """Four rows of three steps each, of which one diverges."""
    root = tmp_path_factory.mktemp("recipe")
    config = config_for(data, root)
    really = runs.train

    def train(training: TrainConfig) -> Path:
        if training.lr > 2e-3:
            raise NonFiniteLoss("the loss of step 1 is not finite; its batch is elsewhere")
        return really(training)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "train", train)
        return root, config, evaluate(config)


def five_digits(values: dict) -> dict:
    return {key: float(f"{value:.5g}") if isinstance(value, float) else value for key, value in values.items()}


def test_rows_change_what_they_say_and_nothing_else(data, tmp_path):
    """A row changes more than it is about, or less: against the settings that are written out here."""
    changed = ("noise.position=0.03", "lr=0.002", "pushforward.share=0.1")
    common = compare._common(config_for(data, tmp_path, settings=changed), "small")
    given = settings.described(common)
    found = {}
    for row in recipe.recipe(common):
        changed = settings.described(row.of(common))
        assert changed.keys() == given.keys()
        found[row.name] = {key: changed[key] for key in given if changed[key] != given[key]}
    no_noise = {"noise.position": 0.0, "noise.offset": 0.0}
    no_turns = {"augmentation.mirror": 0.0, "augmentation.yaw": 0.0}
    paper = {
        "network.residual": False, "network.heading": "world", "network.norm_first": False,
        "network.activation": "relu", "noise.features": recipe.PAPER_NOISE, "pushforward.share": 0.0, "average": 0.0,
    }  # fmt: skip
    expected = {
        "as_given": {},
        "paper": paper | no_noise | no_turns,
        "without_pushforward": {"pushforward.share": 0.0},
        "noise_none": no_noise,
        "noise_third": {"noise.position": 0.01, "noise.offset": 0.01 / 3},
        "noise_triple": {"noise.position": 0.09, "noise.offset": 0.03},
        "lr_third": {"lr": 0.002 / 3},
        "lr_triple": {"lr": 0.006},
        "without_average": {"average": 0.0},
        "without_augmentation": no_turns,
        "whole_garments": {"splits": 1},
        "unrolled": {"unroll.steps": 2},
    }
    assert found.keys() == expected.keys()
    for name, changed in expected.items():
        assert five_digits(found[name]) == five_digits(changed), name  # settings have six


def test_an_unrolled_recipe_is_compared_with_one_step(data, tmp_path):
    """The row would change nothing, or a recipe that cannot be unrolled would have no table at all."""

    def names(*changes):
        config = config_for(data, tmp_path, settings=(*QUICK, *changes), rows=())
        return {row.name: row for row in compare.plan(config)[1]}

    assert names("unroll.steps=3")["one_step"].settings == ("unroll.steps=1",)
    assert {"unrolled", "one_step"}.isdisjoint(names("compile=true"))


def test_a_recipe_is_compared_with_and_without_push_forward(data, tmp_path):
    """The row would change nothing."""

    def names(share):
        config = config_for(data, tmp_path, settings=(*QUICK, f"pushforward.share={share}"), rows=())
        return {row.name: row.settings for row in compare.plan(config)[1]}

    assert names(0.1)["without_pushforward"] == ("pushforward.share=0.0",)
    assert names(0.0)["pushforward"] == ("pushforward.share=0.25",)
    assert "pushforward" not in names(0.1)
    assert "without_pushforward" not in names(0.0)


def test_rows_that_would_be_the_recipe_itself_are_left_out(data, tmp_path):
    """A recipe of whole garments would be trained twice, and its two rows would differ by nothing; asked for by name,
    such a row is refused."""
    whole = (*QUICK, "splits=1")
    _, rows = compare.plan(config_for(data, tmp_path, settings=whole, rows=()))
    assert "whole_garments" not in {row.name for row in rows}
    assert len(rows) == len(recipe.recipe(TrainConfig(data=data, out=tmp_path, steps=1))) - 1
    with pytest.raises(variants.RowError, match="would be the same"):
        compare.plan(config_for(data, tmp_path, settings=whole, rows=("as_given", "whole_garments")))


def test_the_table_says_what_changed_and_what_it_did(made):
    """Figures are missing or of another row: validation errors are those of the runs' own logs, and errors and verdicts
    follow from the sequences' figures."""
    root, config, result = made
    rows = {row["row"]: row for row in result["rows"]}
    assert list(rows) == ["as_given", "paper", "lr_third", "baselines"]
    for name in ("as_given", "paper", "lr_third"):
        log = [json.loads(line) for line in (root / "runs/recipe" / name / "log.jsonl").read_text().splitlines()]
        best = min(entry["rollout_error_cm"] for entry in log if "rollout_error_cm" in entry)
        assert rows[name]["validation_cm"] == pytest.approx(best, abs=0.005)
    assert rows["lr_third"]["changed"] == "lr was 0.001, is 0.000333333"
    assert rows["as_given"]["changed"] == "nothing"
    assert rows["lr_third"]["compared"] == 2  # one sequence, two starts
    text = (config.out / "recipe.md").read_text()
    for expected in ("lr was 0.001", "validation [cm]", "geodesic distortion", "inside body", "as given"):
        assert expected in text
    assert "No row lr_triple, its training ended: the loss of step 1 is not finite." in text
    assert sorted(p.name for p in config.out.iterdir()) == ["recipe.json", "recipe.md", "recipe.png"]
    assert (config.out / "recipe.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert report.command(config).endswith("--rows as_given paper lr_third lr_triple --steps 3 --overrides "
                                           + " ".join(SHAPE) + " --settings " + " ".join(QUICK))  # fmt: skip


def test_rows_from_before_a_setting_came_are_used_again(made, data, tmp_path):
    """A new setting of the training would make every row trained before it useless, though it has its default there;
    with another value the row is still refused."""
    root, config, _ = made
    shutil.copytree(root / "runs/recipe/lr_third", tmp_path / "row")
    record = json.loads((tmp_path / "row/row.json").read_text())
    record["settings"] = {k: v for k, v in record["settings"].items() if not k.startswith("unroll.")}
    (tmp_path / "row/row.json").write_text(json.dumps(record))
    training = compare.plan(config)[0]["lr_third"]
    assert runs.trained(tmp_path / "row", training, runs.identity(data)).steps == 3
    with pytest.raises(runs.RunMismatch, match=r"unroll\.steps was 1, is 2"):
        runs.trained(tmp_path / "row", replace(training, unroll=UnrollConfig(steps=2)), runs.identity(data))


def rows_with(errors: dict[str, list[tuple[float, float]]]) -> list[dict]:
    """Rows with (warm, cold) errors of each sequence."""
    rows = []
    for name, pairs in errors.items():
        sequences = [
            {"sequence": str(i), "start": start, "network": {"mean_vertex_error_cm": pair[k]}}
            for i, pair in enumerate(pairs)
            for k, start in enumerate(("warm", "cold"))
        ]
        mean = {
            start: {"network": {"mean_vertex_error_cm": sum(p[k] for p in pairs) / len(pairs)}}
            for k, start in enumerate(("warm", "cold"))
        }
        rows.append({"row": name, "label": name, "mean": mean, "sequences": sequences})
    return rows


def test_verdicts():
    """A change that helped by luck on one sequence is said to help: means and two thirds of rollouts must agree."""
    rows = rows_with(
        {
            "as_given": [(2.0, 3.0), (2.0, 3.0), (2.0, 3.0)],
            "all_better": [(1.9, 2.9), (1.9, 2.9), (1.9, 2.9)],
            "one_much_better": [(0.1, 0.1), (2.1, 3.1), (2.1, 3.1)],
            "all_worse": [(2.1, 3.1), (2.1, 3.1), (1.99, 3.1)],
            "hardly_better": [(1.99, 2.99), (1.99, 2.99), (1.99, 2.99)],
            "one_start_better": [(1.9, 3.1), (1.9, 3.1), (1.9, 3.1)],
        }
    )
    recipe.judged(rows)
    verdicts = {row["row"]: row.get("verdict") for row in rows}
    assert verdicts == {
        "as_given": None, "all_better": "helps", "one_much_better": "open", "all_worse": "hurts",
        "hardly_better": "open",
        "one_start_better": "open",
    }  # fmt: skip
    assert rows[1]["change"] == pytest.approx({"warm": -0.05, "cold": -1.0 / 30.0})
    assert recipe.summary(rows)[3] == "- Helped: all_better (warm -5.0%, cold -3.3%)."
    alone = rows_with({"lr_third": [(1.0, 1.0)]})
    recipe.judged(alone)  # no row as given to compare with
    assert "verdict" not in alone[0]
