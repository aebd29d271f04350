"""Garments that are worn together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

from warpgarment.errors import UsageError

from .garment import Garment
from .material import Material


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Outfit(Sequence[Garment]):
    """Garments over each other on one body, innermost first; a sequence of garments that is not changed.

        outfit = wg.Outfit([shirt, jacket], materials=[wg.Material.cotton(), wg.Material.denim()])
        shirt, jacket = simulator.rollout(outfit, body)

    A simulation keeps them from crossing each other and themselves, as with `layers=True`.

    Args:
        garments: The garments, innermost first.
        materials: Material of each garment, or None for one without; one for all; or None. Only for networks that read
            them.

    Attributes:
        garments: The garments, a tuple.
        materials: Material of each garment, a tuple; None if none was given.

    Raises:
        UsageError: There is no garment, one is given twice, or there are as many materials.
        TypeError: One is no garment or material.
    """

    garments: tuple[Garment, ...]
    materials: tuple[Material | None, ...] | None

    def __init__(
        self, garments: Sequence[Garment], materials: Material | Sequence[Material | None] | None = None
    ) -> None:
        worn = (garments,) if isinstance(garments, Garment) else tuple(garments)
        for garment in worn:
            if not isinstance(garment, Garment):
                raise TypeError(f"an outfit is made of garments, got {type(garment).__name__}")
        if not worn:
            raise UsageError("an outfit without garments. Give at least one, innermost first")
        if len({id(garment) for garment in worn}) < len(worn):
            raise UsageError("an outfit with the same garment twice, which would lie in itself. Give each once")
        if materials is not None:
            materials = (materials,) * len(worn) if isinstance(materials, Material) else tuple(materials)
            for material in materials:
                if not isinstance(material, Material | None):
                    raise TypeError(f"expected a Material or None, got {type(material).__name__}")
            if len(materials) != len(worn):
                raise UsageError(
                    f"an outfit of {len(worn)} garments and {len(materials)} materials. Give one for each, None for a "
                    "garment without, or a single one for all"
                )
        object.__setattr__(self, "garments", worn)
        object.__setattr__(self, "materials", materials)

    def __len__(self) -> int:
        return len(self.garments)

    @overload
    def __getitem__(self, index: int) -> Garment: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Garment, ...]: ...

    def __getitem__(self, index: Any) -> Any:
        return self.garments[index]

    def __repr__(self) -> str:
        return f"Outfit({' under '.join(garment.name or 'garment' for garment in self.garments)})"
