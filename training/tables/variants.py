"""The rows of the tables that compare networks: what each changes, everything else being equal.

Table 1 takes the manifold heads away (their places go to learned heads, so the number of heads and parameters stays),
and the singular values (neither part of the loss nor put into the deformation gradients, section 5.2). Table 2 varies
the power p of the attention weights softmax(-(D/r)^p) at the radius r of the given shape, and r at its p; the paper has
D in metres, which is r = 1 m.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

from warpgarment.nn.config import NetworkConfig
from warpgarment.training.train.config import TrainConfig

from .settings import with_settings

POWERS = (0.01, 0.1, 1.0, 10.0, 20.0, 50.0, 100.0)  # those of the paper
RADII = (0.05, 0.15, 0.3, 0.6, 1.0)  # metres


class RowError(ValueError):
    """Rows that do not exist, or that would not differ."""


@dataclass(frozen=True)
class Variant:
    """A row: its name (and folder), what stands in the table, and the settings that make it different.

    Attributes:
        name: Of the row and its folder.
        label: In the table.
        overrides: Of the network, name=value.
        settings: Of the training, name=value.
        value: Where the row lies on the axis of table 2: (setting, number).
    """

    name: str
    label: str
    overrides: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    value: tuple[tuple[str, float], ...] = ()

    def of(self, config: TrainConfig) -> TrainConfig:
        """The row's training, from what all rows have in common."""
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
    """The rows of table 2 around a network: powers at its radius, then radii at its power, itself once."""
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
    """Those of the names, in the table's order.

    Raises:
        RowError: There is no such row.
    """
    unknown = sorted(set(names) - {v.name for v in variants})
    if unknown:
        raise RowError(f"no rows {', '.join(unknown)}; there are {', '.join(v.name for v in variants)}")
    return [v for v in variants if not names or v.name in names]


def check_different(configs: dict[str, TrainConfig]) -> None:
    """Refuses rows that are the same training, as common overrides can make them.

    Raises:
        RowError: Names the two, or the row whose setting the network does not have.
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
