"""Figures of rollouts of outfits, by hand: sheets over a flat body, shifted, exchanged, broken."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import sequences

from warpgarment.training.data.sequence import Sequence
from warpgarment.training.tables.outfits.collisions import Surface
from warpgarment.training.tables.outfits.figures import Outfit, rollout_figures
from warpgarment.training.tables.outfits.means import beside, means

SQUARE = np.array([[x, 0.0, z] for z in (-0.2, 0.0, 0.2) for x in (-0.2, 0.0, 0.2)])
FACES = np.array([[0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5], [3, 6, 4], [4, 6, 7], [4, 7, 5], [5, 7, 8]])
BLOCK = np.concatenate([2.0 * SQUARE, 2.0 * SQUARE - [0, 0.3, 0]])  # two sheets, the lower one looks down
BLOCK_FACES = np.concatenate([FACES, FACES[:, ::-1] + 9])


def sheets(count: int) -> Outfit:
    """An outfit of so many squares that face up."""
    parts = tuple(slice(9 * k, 9 * k + 9) for k in range(count))
    faces = np.concatenate([FACES + 9 * k for k in range(count)])
    surfaces = tuple(Surface.of(FACES, 9) for _ in range(count))
    owner = np.repeat(np.arange(count), len(FACES))
    return Outfit(parts, faces, owner, np.arange(9 * count), surfaces, ("a",) * count, 0.01, 0.0)


def at(*heights: float) -> np.ndarray:
    """Squares at some heights [m]; each a little smaller than the one before, so that no border is above another."""
    return np.concatenate([SQUARE * (1.0 - 0.05 * k) + [0.0, h, 0.0] for k, h in enumerate(heights)])


def figures(predicted: list[np.ndarray], truth: np.ndarray) -> dict:
    frames = np.stack(predicted).astype(np.float32)
    return rollout_figures(
        sheets(len(truth) // 9), frames, np.repeat(truth[None], len(frames), 0), np.repeat(BLOCK[None], len(frames), 0),
        BLOCK_FACES,
    )  # fmt: skip


def test_sheets_in_order_and_out_of_order():
    """Shares would be of other vertices or frames. Two sheets 10 and 20 mm above a body: nothing collides. In one of
    two frames the outer one lies beneath the inner one: half of L, nothing of H. Errors are the shifts, 1e-3 mm."""
    truth = at(0.01, 0.02)
    good = figures([truth, truth], truth)
    assert good["error_mm"] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert [good[k] for k in ("h_published", "h_surface", "l_published", "l_surface")] == [0.0] * 4
    assert (good["crossings_layers"], good["crossings_itself"], good["free"]) == (0.0, 0.0, 1.0)
    swapped = figures([truth, at(0.01, 0.005)], truth)
    assert swapped["error_mm"] == pytest.approx([0.0, 7.5], abs=1e-3)
    assert [swapped[k] for k in ("h_published", "h_surface", "l_published", "l_surface")] == [0.0, 0.0, 0.5, 0.5]
    assert swapped["free"] == 1.0  # beneath, yet no triangle crosses


def test_cloth_inside_the_body_and_through_cloth():
    """Body and layers would be mixed up. The inner sheet 10 mm inside the body: half of all vertices. One outer vertex
    pushed through the inner sheet: a ninth of L, and crossing triangles in that frame."""
    truth = at(0.01, 0.02)
    inside = figures([at(-0.01, 0.02)], truth)
    assert [inside[k] for k in ("h_published", "h_surface", "l_published")] == [0.5, 0.5, 0.0]
    pushed = truth.copy()
    pushed[9 + 4, 1] = 0.005
    through = figures([truth, pushed], truth)
    assert through["l_published"] == through["l_surface"] == pytest.approx(0.5 / 9)
    assert through["crossings_layers"] > 0
    assert through["crossings_itself"] == 0
    assert through["free"] == 0.5


def test_of_three_layers_all_but_the_innermost_count_by_surfaces():
    """A middle garment beneath the innermost would go unseen: as published only the outermost counts, by surfaces half
    of the vertices of the outer two do."""
    truth = at(0.01, 0.02, 0.03)
    middle = figures([at(0.01, 0.005, 0.03)], truth)
    assert (middle["l_published"], middle["l_surface"]) == (0.0, 0.5)


def test_a_rollout_that_is_not_finite_is_counted_and_has_no_figures():
    """NaN would be dropped silently, or make a mean NaN. By hand."""
    truth = at(0.01, 0.02)
    broken = truth.copy()
    broken[3] = np.nan
    failed = figures([truth, broken, truth], truth) | {"garments": ["a", "a"], "frames": 3, "seconds": 1.0}
    assert (failed["finite"], failed["finite_frames"], failed["error_mm"]) == (False, 1, None)
    good = figures([at(0.02, 0.04)], truth) | {"garments": ["a", "b"], "frames": 1, "seconds": 1.0}
    mean = means([failed, good])
    assert (mean["failed"], mean["sequences"], mean["garments"], mean["frames"]) == (1, 2, 2, 4)
    assert (mean["error_mm"], mean["spread_mm"]) == pytest.approx((15.0, 5.0), abs=1e-3)
    assert mean["ms"] == pytest.approx(500.0)
    assert means([good], lambda k, of: of[k] == "b")["error_mm"] == pytest.approx(20.0, abs=1e-3)
    assert math.isnan(means([failed])["error_mm"])


def test_rows_are_compared_where_both_are_finite():
    """A row that fails on what is hard would look better than the baseline. By hand."""
    rollouts = [
        {"sequence": s, "finite": f, "error_mm": e} for s, f, e in (("a", True, [1.0, 3.0]), ("b", False, None))
    ]
    others = [{"sequence": s, "finite": True, "error_mm": e} for s, e in (("a", [4.0, 4.0]), ("b", [99.0, 99.0]))]
    assert beside(rollouts, others) == 0.5
    assert math.isnan(beside(rollouts[1:], others))


@pytest.mark.parametrize(("wind", "cell"), [(2.0, "T+W"), (0.5, "T"), (0.0, "T")])
def test_what_an_outfit_is(tmp_path, wind, cell):
    """A sequence would be in another column of table 4. The inner tube is 3 to 4 cm wider than the capsule, which has
    flat sides that are nearer; wind below 1 m/s is none. Same place at rest, same number."""
    sequence = Sequence.load(sequences.write_worn(tmp_path, "one", wind=wind, frames=3))
    outfit = Outfit.of(sequence, sequence.body())
    assert 0.02 < outfit.ease < 0.06
    assert outfit.cell == ("L" if outfit.ease > 0.035 else "T") + cell[1:]
    assert outfit.categories == ("dress", "jacket")
    assert len(np.unique(outfit.same)) == len(outfit.same)
    assert outfit.wind == pytest.approx(math.hypot(wind, 0.1) if wind else 0.0, rel=1e-6)
