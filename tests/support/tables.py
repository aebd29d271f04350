"""A small data set, an untrained network and tables of a few steps, for the tests of tables."""

from __future__ import annotations

from pathlib import Path

import torch

from support import sequences as synthetic_sequences
from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.training.evaluate.measure import EvaluateConfig
from warpgarment.training.tables.options import TableOptions

SHAPE = ("dropout=0.0", "embedding=16", "layers=1", "feed_forward=16", "heads=2", "manifold_heads=1")
QUICK = (
    "batch_size=2", "validate_frames=4", "validate_sequences=1", "statistics_batches=2", "ahead=0",
    "pushforward.share=0.0", "save_every=2", "validate_every=2", "log_every=1",
)  # fmt: skip
NETWORK = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2)


def small_set(root: Path) -> Path:
    """Writes a data set of two sequences for training, one for validation and one for tests."""
    return synthetic_sequences.write_set(root / "sequences", train=2, frames=16, pins=4)


def random_network(path: Path) -> Path:
    """Saves an untrained network whose output is not only skin, so that its inputs affect its predictions."""
    torch.manual_seed(0)
    module = ManifoldAwareTransformer(NETWORK)
    for head in (module.face_head, module.velocity_head):
        torch.nn.init.normal_(head.weight, std=1e-3)
    checkpoint.save(module, path)
    return path


def table_config(data: Path, root: Path, table: str = "table2", **options) -> EvaluateConfig:
    base = {"runs": root / "runs", "steps": 3, "overrides": SHAPE, "settings": QUICK}
    if table == "table2":
        base["rows"] = ("power_1", "radius_0.3")
    tables = TableOptions(**(base | options))
    return EvaluateConfig(
        data=data, out=root / "out", table=table, tables=tables, device="cpu", frames=4, geodesic_frames=1
    )
