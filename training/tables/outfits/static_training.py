"""Trains the static garment model on the training split of a data set, for a stated time of one processor."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from warpgarment.training.data.sequence import Sequence
from warpgarment.training.tables.options import DataLacks
from warpgarment.training.train.training_set import folders_of, reason_of

from .static import Bound, StaticGarment

FRAMES = 8  # of one sequence in a step
EDGES = 0.1  # weight of the edges' lengths beside the positions


@dataclass(frozen=True)
class Recorded:
    """A sequence to train on: F edges of the garments, T frames.

    Attributes:
        bound: The outfit, bound in frame 0.
        turns, middles: Pose of the body's points, [T,N,3,3] and [T,N,3].
        truth: Positions [m], [T,V,3].
        edges: Vertices of the edges, int64 [2,E].
    """

    bound: Bound
    turns: torch.Tensor
    middles: torch.Tensor
    truth: torch.Tensor
    edges: torch.Tensor

    @classmethod
    def of(cls, folder: Path) -> Recorded:
        """Reads a sequence."""
        sequence = Sequence.load(folder)
        body = sequence.body()
        if not np.isfinite(np.asarray(sequence.vertices)).all():
            raise ValueError("recorded garment positions are not finite")
        bound = Bound.of(sequence, body)
        turns, middles = bound.pose(np.asarray(body.vertices))
        edges = torch.from_numpy(np.asarray(sequence.garment.edges, np.int64).T.copy())
        return cls(bound, turns, middles, torch.from_numpy(np.array(sequence.vertices, np.float32)), edges)

    def loss(self, network: StaticGarment, frames: torch.Tensor) -> torch.Tensor:
        """Mean squared distance of vertices [cm²], and of the lengths of edges from the recorded ones."""
        found, truth = network(self.bound, self.turns[frames], self.middles[frames]), self.truth[frames]
        i, j = self.edges
        lengths = [(x[:, i] - x[:, j]).norm(dim=-1) for x in (found, truth)]
        return 1e4 * ((found - truth).square().sum(-1).mean() + EDGES * (lengths[0] - lengths[1]).square().mean())

    @torch.no_grad()
    def error_mm(self, network: StaticGarment) -> float:
        """Mean distance of vertices over every fifth frame [mm]."""
        frames = torch.arange(0, len(self.truth), 5)
        found = network(self.bound, self.turns[frames], self.middles[frames])
        return 1000.0 * float((found - self.truth[frames]).norm(dim=-1).mean())


def train_static(data: Path, file: Path, minutes: float, *, seed: int = 0, rate: float = 1e-3) -> dict[str, Any]:
    """Trains the model and writes it.

    Args:
        data: Folder of sequences.
        file: File of safetensors to write.
        minutes: Time of the processor, all threads together, without the reading of the data [min].
        seed: Seed of the weights and of the order.
        rate: Learning rate at the start; it falls to zero along a cosine.

    Returns:
        `minutes`, `steps`, `train` and `validation` (numbers of sequences), `error_mm` before and after on the
        validation split (the training split if there is none), `skipped`.

    Raises:
        DataLacks: No sequence can be trained on.
    """
    skipped: dict[str, str] = {}
    sets: dict[str, list[Recorded]] = {"train": [], "validation": []}
    for split, found in sets.items():
        for folder in tqdm(folders_of(Path(data), split, skipped), desc=split, unit="sequence", leave=False):
            try:
                found.append(Recorded.of(folder))
            except Exception as error:
                skipped[folder.name] = reason_of(error)
    if not sets["train"]:
        raise DataLacks(f"{data}: no sequence to train on; {len(skipped)} were skipped")
    judged = sets["validation"] or sets["train"]
    torch.manual_seed(seed)
    network = StaticGarment()
    optimiser = torch.optim.Adam(network.parameters(), lr=rate)
    before = float(np.mean([one.error_mm(network) for one in judged]))
    began, steps, spent = time.process_time(), 0, 0.0
    order = np.random.default_rng(seed)
    with tqdm(total=100, desc="training", unit="%", leave=False) as bar:
        while (spent := (time.process_time() - began) / 60.0) < minutes:
            optimiser.param_groups[0]["lr"] = rate * 0.5 * (1.0 + math.cos(math.pi * spent / minutes))
            one = sets["train"][order.integers(len(sets["train"]))]
            frames = torch.from_numpy(order.choice(len(one.truth), min(FRAMES, len(one.truth)), replace=False))
            optimiser.zero_grad()
            one.loss(network, frames).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 100.0)
            optimiser.step()
            steps += 1
            bar.update(int(100 * spent / minutes) - bar.n)
    network.eval()
    after = float(np.mean([one.error_mm(network) for one in judged]))
    notes: dict[str, Any] = {"minutes": round(spent, 2), "steps": steps, "seed": seed, "skipped": skipped}
    notes |= {split: len(found) for split, found in sets.items()} | {"error_mm": {"before": before, "after": after}}
    network.save(file, notes)
    return notes
