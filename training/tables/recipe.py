"""The rows of the table of the recipe: one training setting changed in each, and the effect of the change.

The recipe is the one that the options give. A row that would not differ from it, such as "whole garments" of a recipe
that never splits them, is left out unless it is named in the options.

The row `paper` is section 4.3.2 of the paper as far as it is printed: no residual, the world's heading, its encoder
layers, one step of supervision, Gaussian noise on the normalised features and no other measure against drift. The
paper does not give its sigma_n; `PAPER_NOISE` is a value of this project. Heads and geodesic weights stay as given,
since they are the subject of tables 1 and 2.
"""

from __future__ import annotations

from typing import Any

from warpgarment.training.train.config import TrainConfig

from .protocol import STARTS
from .report import grid
from .settings import described, differences
from .variants import Variant

AS_GIVEN = "as_given"
PUSHFORWARD = 0.25  # share of samples from rollouts in the row of a recipe that has none
PAPER_NOISE = 0.05  # noise in standard deviations of the normalised features
AGREE = 2.0 / 3.0  # share of rollouts that must agree with the means for a verdict
SMALLEST = 0.01  # smallest change of the mean error that counts, as a share
NOTE = (
    "Each row changes what it says, and nothing else. Validation: the best short cold rollouts in training, by which "
    "the network was chosen. Better: rollouts whose error is below that of the recipe as given, of those that both "
    "have. A change helps (or hurts) where the mean error falls (rises) by 1 % or more from both starts and two thirds "
    "of the rollouts agree; otherwise it is open. One seed: what is open may be decided by more data or budget."
)


def recipe(common: TrainConfig) -> list[Variant]:
    """The rows around a recipe; the recipe itself is the first row."""
    noise = common.noise

    def displaced(factor: float) -> tuple[str, ...]:
        return f"noise.position={noise.position * factor:.6g}", f"noise.offset={noise.offset * factor:.6g}"

    shape = ("residual=false", "heading=world", "norm_first=false", "activation=relu")
    plain = (
        "pushforward.share=0.0",
        "average=0.0",
        "augmentation.mirror=0.0",
        "augmentation.yaw=0.0",
        "unroll.steps=1",
    )
    gaussian = (*displaced(0.0), f"noise.features={noise.features or PAPER_NOISE!r}")
    rows = [
        Variant(AS_GIVEN, "as given"),
        Variant("paper", "the paper's own", shape, (*plain, *gaussian)),
        Variant("noise_none", "history not displaced", (), displaced(0.0)),
        Variant("noise_third", "history displaced a third as far", (), displaced(1.0 / 3.0)),
        Variant("noise_triple", "history displaced three times as far", (), displaced(3.0)),
        Variant("lr_third", "a third of the learning rate", (), (f"lr={common.lr / 3.0:.6g}",)),
        Variant("lr_triple", "three times the learning rate", (), (f"lr={common.lr * 3.0:.6g}",)),
        Variant("without_average", "without weight average", (), ("average=0.0",)),
        Variant(
            "without_augmentation", "without mirror and yaw", (), ("augmentation.mirror=0.0", "augmentation.yaw=0.0")
        ),
        Variant("whole_garments", "whole garments throughout", (), ("splits=1",)),
    ]
    if common.pushforward.share:
        rows.append(Variant("without_pushforward", "without push-forward", (), ("pushforward.share=0.0",)))
    else:
        rows.append(Variant("pushforward", "with push-forward", (), (f"pushforward.share={PUSHFORWARD!r}",)))
    if common.unroll.steps > 1:
        rows.append(Variant("one_step", "one step at a time", (), ("unroll.steps=1",)))
    elif not (common.compile or common.augmentation.scale):  # unrolled training supports neither
        rows.append(Variant("unrolled", "two steps in a row", (), ("unroll.steps=2",)))
    return rows


def differing(rows: list[Variant], common: TrainConfig) -> list[Variant]:
    """The rows whose training differs from that of the recipe."""
    given = described(common)
    return [row for row in rows if row.name == AS_GIVEN or described(row.of(common)) != given]


def changes(config: TrainConfig, common: TrainConfig) -> str:
    """The changes of a row, in words."""
    return "; ".join(differences(described(common), described(config))) or "nothing"


def judged(rows: list[dict[str, Any]]) -> None:
    """Adds to each row the effect of its change: `better` of `compared` rollouts, `change` of the mean error per start
    as a share, and the `verdict`. Rows have `row`, `mean` and `sequences`; without the row of the recipe nothing is
    added.
    """
    given = next((row for row in rows if row["row"] == AS_GIVEN), None)
    if given is None:
        return
    errors = _errors(given)
    for row in rows:
        if row is given or "sequences" not in row:
            continue
        pairs = [(error, errors[key]) for key, error in _errors(row).items() if key in errors]
        better = sum(error < reference for error, reference in pairs)
        change = {
            start: _mean_error(row, start) / _mean_error(given, start) - 1.0 for start in STARTS if start in row["mean"]
        }
        agreed = AGREE * len(pairs)
        if pairs and all(c <= -SMALLEST for c in change.values()) and better >= agreed:
            verdict = "helps"
        elif pairs and all(c >= SMALLEST for c in change.values()) and len(pairs) - better >= agreed:
            verdict = "hurts"
        else:
            verdict = "open"
        row |= {"better": better, "compared": len(pairs), "change": change, "verdict": verdict}


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Markdown of each row's change and its effect, then of the changes that helped, hurt, or are undecided."""
    cells = []
    for row in (row for row in rows if "changed" in row):
        validation = "" if row["validation_cm"] is None else f"{row['validation_cm']:.2f}"
        better = f"{row['better']} of {row['compared']}" if "better" in row else ""
        cells.append([row["label"], row["changed"], validation, better, row.get("verdict", "")])
    lines = [*grid(["", "changed", "validation [cm]", "better", "verdict"], cells), ""]
    for verdict, heading in (("helps", "Helped"), ("hurts", "Hurt"), ("open", "Open")):
        labels = [
            f"{row['label']} (" + ", ".join(f"{start} {c:+.1%}" for start, c in row["change"].items()) + ")"
            for row in rows
            if row.get("verdict") == verdict
        ]
        lines += [f"- {heading}: {'; '.join(labels)}."] if labels else []
    return lines


def _errors(row: dict[str, Any]) -> dict[tuple[str, str], float]:
    """(sequence, start) -> error [cm]; infinite if the rollout failed."""
    return {(s["sequence"], s["start"]): s["network"]["mean_vertex_error_cm"] for s in row["sequences"]}


def _mean_error(row: dict[str, Any], start: str) -> float:
    return row["mean"][start]["network"]["mean_vertex_error_cm"]
