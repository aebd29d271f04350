"""The paper's tables and figures, one command each, on one's own data:

    warpgarment evaluate --table table1 --data DATA --steps 20000       # manifold heads, singular values
    warpgarment evaluate --table table2 --data DATA --steps 20000       # power and radius of the geodesic attention
    warpgarment evaluate --table recipe --data DATA --time-limit 60     # the benefit of each training setting
    warpgarment evaluate --table figure5                                # time by stage
    warpgarment evaluate --table figure7 --data DATA                    # one garment at several resolutions
    warpgarment evaluate --table figure9 --data SEAMS                   # unseen seam cuts
    warpgarment evaluate --table figure12 --data DATA                   # bodies never seen
    warpgarment evaluate --table category --data DATA                   # a garment category never seen
    warpgarment evaluate --table long --data DATA                       # rollouts of 1,000 frames
    warpgarment evaluate --table outdoor --data LAYERS                  # the right material and wind, others, none

All of them measure by the protocol of `protocol.py` and write JSON, Markdown and PNG, by default to benchmarks/results.
"""

from __future__ import annotations

import importlib
from typing import Any

MAKERS = {
    "table1": "compare",
    "table2": "compare",
    "recipe": "compare",
    "figure5": "figure5",
    "figure7": "figure7",
    "figure9": "groups",
    "figure12": "groups",
    "category": "groups",
    "long": "long",
    "outdoor": "outdoor.table",
}


def make_table(config: Any) -> dict[str, Any]:
    """Makes the table that an `EvaluateConfig` names and writes it.

    Returns:
        The contents of its JSON file: `table`, `title`, `command`, `machine`, `rows`, and entries of the single table.
    """
    return importlib.import_module(f"{__name__}.{MAKERS[config.table]}").make(config)
