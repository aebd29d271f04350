"""The rows of the tables that compare networks: the one change of each row, with all other settings equal.

Table 1 removes the manifold heads (learned heads take their places, so the number of heads and parameters does not
change), and the singular values (which are then neither part of the loss nor put into the deformation gradients,
section 5.2). Table 2 varies the power p of the attention weights softmax(-(D/r)^p) at the radius r of the given shape,
and r at its p; the paper has D in metres, which is r = 1 m.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

from warpgarment.nn.config import NetworkConfig
from warpgarment.training.train.config import TrainConfig

from .settings import with_settings

POWERS = (0.01, 0.1, 1.0, 10.0, 20.0, 50.0, 100.0)  # powers p in the paper
RADII = (0.05, 0.15, 0.3, 0.6, 1.0)  # metres


class RowError(ValueError):
    """Rows that do not exist, or that would not differ."""


@dataclass(frozen=True)
class Variant:
    """A row: its name (and folder), its label in the table, and the settings that make it different.

    Attributes:
        name: Name of the row and its folder.
        label: Label in the table.
        overrides: Settings of the network, name=value.
        settings: Settings of the training, name=value.
        value: Place of the row on the axis of table 2: setting and number.
    """

    name: str
    label: str
    overrides: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    value: tuple[tuple[str, float], ...] = ()

    def of(self, config: TrainConfig) -> TrainConfig:
        """The training of the row, from the configuration that all rows have in common."""
        changed = replace(config, overrides=(*config.overrides, *self.overrides))
        return with_settings(changed, self.settings)


def table1() -> list[Variant]:
    """The rows of table 1, in the paper's order."""
    no_values = ("replace_singular_values=false",), ("loss.singular_values=0.0",)
    return [
        Variant("without_manifold_heads", "without manifold heads", ("manifold_heads=0",)),
        Variant("without_singular_values", "without singular values", *no_values),
        Variant("full", "full"),
    ]


def table2(network: NetworkConfig) -> list[Variant]:
    """The rows of table 2 around a network: powers at its radius, then radii at its power; the network itself once."""
    power, radius = network.geodesic_power, network.geodesic_radius
    places = [(p, radius) for p in sorted({*POWERS, power})]
    places += [(power, r) for r in RADII if r != radius]
    rows = []
    for p, r in places:
        name = "as_given" if (p, r) == (power, radius) else f"power_{p:g}" if r == radius else f"radius_{r:g}"
        label = f"p = {p:g}, r = {r:g} m" + (", as given" if name == "as_given" else "")
        where: tuple[tuple[str, float], ...] = (("power", p),) if r == radius else ()
        where += (("radius", r),) if p == power else ()
        rows.append(Variant(name, label, (f"geodesic_power={p!r}", f"geodesic_radius={r!r}"), value=where))
    return rows


def chosen(variants: list[Variant], names: tuple[str, ...]) -> list[Variant]:
    """The rows with the given names, in the table's order; all rows if there are no names.

    Raises:
        RowError: A row does not exist.
    """
    unknown = sorted(set(names) - {v.name for v in variants})
    if unknown:
        raise RowError(f"no rows {', '.join(unknown)}; there are {', '.join(v.name for v in variants)}")
    return [v for v in variants if not names or v.name in names]


def check_different(configs: dict[str, TrainConfig]) -> None:
    """Refuses rows with equal training, which common overrides can cause.

    Raises:
        RowError: Two rows are equal, or the network lacks a setting of a row; the error names the rows.
    """
    resolved = {}
    for name, config in configs.items():
        try:
            resolved[name] = (config.network_config(), replace(config, overrides=()))
        except ValueError as error:
            raise RowError(f"row {name}: {error}") from error
    for (a, of_a), (b, of_b) in itertools.combinations(resolved.items(), 2):
        if of_a == of_b:
            raise RowError(f"rows {a} and {b} would be the same training; leave what they differ in out of overrides")
