"""Tables 1 and 2 and the table of the recipe: networks that differ in one setting, trained on one budget and measured
on one set of sequences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.splits import evenly
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.run import NonFiniteLoss
from warpgarment.training.train.training_set import folders_of
from warpgarment.view.markdown import escape

from . import recipe, variants
from .options import DataLacks, OptionMissing
from .pictures import bars, sweeps
from .protocol import means, measure
from .report import BASELINES, PROTOCOL, means_table, publish
from .runs import identity, trained
from .settings import with_settings

SHAPES = ("small", "base", "fast")
TITLES = {
    "table1": "Table 1: what manifold heads and singular values are worth",
    "table2": "Table 2: power and radius of the geodesic attention",
    "recipe": "The recipe: what each training setting is worth",
}
PAPER = {
    "table1": "The paper, on its own data: 4.54 cm without manifold heads, 12.2 without singular values, 3.19 in full; "
    "geodesic distortion 2.83e-2, 9.33e-2 and 2.05e-2.",
    "table2": "The paper, on its own data, with D in metres (r = 1 m): 4.34 cm at p = 0.01, then 3.79 (0.1), 3.23 (1), "
    "3.31 (10), 3.19 (20), 3.20 (50), 4.72 (100).",
}


def make(config: Any) -> dict[str, Any]:
    """Trains the rows that are not trained yet, measures every row and writes the table.

    Raises:
        RunMismatch: The folder of a row holds another run.
        RowError, SettingError: A row or setting does not exist.
        OptionMissing, DataLacks: There is no budget, no data or no test sequence.
    """
    configs, chosen = plan(config)
    root, skipped = Path(config.data), dict[str, str]()
    folders = evenly(folders_of(root, config.split, skipped), config.max_sequences)
    if not folders:
        unread = f" ({len(skipped)} have no readable manifest)" if skipped else ""
        raise DataLacks(
            f"{root}: no {config.split} sequences{unread}. `warpgarment generate --out DIR` makes a set with some"
        )
    data = identity(root)
    rows: list[dict[str, Any]] = []
    runs, diverged = {}, dict[str, str]()
    for variant in chosen:
        folder = Path(config.tables.runs) / config.table / variant.name
        try:
            runs[variant.name] = trained(folder, configs[variant.name], data)
        except NonFiniteLoss as error:
            diverged[variant.name] = str(error).partition(";")[0]
    if not runs:
        raise DataLacks(
            f"every row's training diverged ({'; '.join(diverged.values())}); give a lower lr in --settings"
        )
    for variant in (v for v in chosen if v.name in runs):
        run = runs[variant.name]
        simulator = Simulator(checkpoint.load(run.file), config.device)
        baselines = config.baselines and not rows  # measured once, since they are the same for all rows
        measured = measure(
            simulator, folders, frames=config.frames, geodesic_frames=config.geodesic_frames, baselines=baselines
        )
        if not measured.rows:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in list(measured.skipped.items())[:3])
            raise DataLacks(f"{root}: no {config.split} sequence can be evaluated ({reasons})")
        skipped |= measured.skipped
        mean = means(measured.rows)
        own = {start: {"network": methods["network"]} for start, methods in mean.items()}
        rows.append(
            {"row": variant.name, "label": variant.label, "mean": own, "steps": run.steps, "hours": run.hours}
            | {"value": dict(variant.value), "overrides": variant.overrides, "settings": variant.settings}
            | {"parameters": simulator.network.parameter_count(), "sequences": measured.rows}
            | {"validation_cm": None if run.validation is None else round(run.validation, 2)}
        )
        if baselines:
            beside = {s: {m: f for m, f in methods.items() if m in BASELINES} for s, methods in mean.items()}
    if config.baselines:
        rows.append({"row": "baselines", "label": "", "mean": beside})
    result = {"table": config.table, "title": TITLES[config.table], "protocol": PROTOCOL, "data": data}
    result |= {"budget": _budget(config), "rows": rows, "diverged": diverged, "skipped": skipped}
    body = [PROTOCOL, "", f"Every row: {_budget(config)}.", ""]
    if config.table == "recipe":
        body += _recipe(config, rows, configs)
    else:
        body += [*means_table(rows, {"steps": "steps", "hours": "hours"}), "", PAPER[config.table]]
    body += [
        line
        for name, reason in diverged.items()
        for line in ("", f"No row {name}, its training ended: {escape(reason)}.")
    ]
    draw = sweeps if config.table == "table2" else bars
    publish(config, result, body, lambda path: draw(path, rows))
    return result


def plan(config: Any) -> tuple[dict[str, TrainConfig], list[variants.Variant]]:
    """The training configuration of each row by name, and the rows; nothing is trained here."""
    options = config.tables
    if config.data is None:
        raise OptionMissing(f"{config.table} needs --data FOLDER")
    if (options.steps is None) == (options.time_limit is None):
        raise OptionMissing(f"{config.table} trains networks: give their budget, --steps N or --time-limit MINUTES")
    shape = "small" if config.network == "default" else config.network
    if shape not in SHAPES:
        raise OptionMissing(f"{config.table} trains networks of its own; --network is their shape: {', '.join(SHAPES)}")
    common = _common(config, shape)
    variants.check_different({"all": common})  # raises an error if an override does not exist
    if config.table == "recipe":
        rows = recipe.recipe(common)
        rows = rows if options.rows else recipe.differing(rows, common)
    else:
        rows = variants.table1() if config.table == "table1" else variants.table2(common.network_config())
    rows = variants.chosen(rows, options.rows)
    configs = {variant.name: variant.of(common) for variant in rows}
    variants.check_different(configs)
    return configs, rows


def _common(config: Any, shape: Any) -> TrainConfig:
    """The training configuration from which all rows start."""
    options = config.tables
    common = TrainConfig(
        data=Path(config.data),
        out=Path(options.runs),
        network=shape,
        overrides=options.overrides,
        steps=options.steps,
        time_limit=options.time_limit,
        seed=options.seed,
        device=config.device,
        threads=config.threads,
    )
    return with_settings(common, options.settings)


def _recipe(config: Any, rows: list[dict[str, Any]], configs: dict[str, TrainConfig]) -> list[str]:
    """Adds their change and its effect to the rows; returns the Markdown of all of them."""
    common = _common(config, next(iter(configs.values())).network)
    for row in rows:
        if row["row"] in configs:
            row["changed"] = recipe.changes(configs[row["row"]], common)
    recipe.judged(rows)
    return [*means_table(rows, {"steps": "steps", "hours": "hours"}), "", recipe.NOTE, "", *recipe.summary(rows)]


def _budget(config: Any) -> str:
    options = config.tables
    shape = "small" if config.network == "default" else config.network
    length = f"{options.steps:,} steps" if options.steps is not None else f"{options.time_limit:g} minutes"
    changes = " ".join((*options.overrides, *options.settings))
    return f"network {shape} {changes}".rstrip() + f", {length}, seed {options.seed}, the same data"
