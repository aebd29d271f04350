"""Takes outfits in the arguments of a simulation apart, and puts results together as outfits were given."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

from warpgarment.errors import UsageError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.outfit import Outfit
from warpgarment.sim.arguments import Layers, listed
from warpgarment.sim.outdoors import Materials


class Given(NamedTuple):
    """Arguments of a simulation, without outfits.

    Attributes:
        garments: All garments.
        single: Whether one garment was given instead of a list.
        body: Body of all garments, or a list with one for each.
        layers: What is worn together.
        materials: Materials of the garments.
        starts: First positions of the garments, or histories.
        sizes: Number of garments of each outfit, if a list of outfits was given.
    """

    garments: list[Garment]
    single: bool
    body: Any
    layers: Layers
    materials: Materials
    starts: tuple[Any, ...]
    sizes: tuple[int, ...] = ()

    def folded(self, results: list[Any]) -> Any:
        """Results of the garments, as they were given: one, a list of them, or a list for each outfit."""
        if not self.sizes:
            return results[0] if self.single else results
        rest = iter(results)
        return [[next(rest) for _ in range(size)] for size in self.sizes]


def numbered(bodies: Sequence[BodyMotion]) -> tuple[list[BodyMotion], list[int]]:
    """Each body once, and the number of the body of each garment; the same object is one body."""
    unique = list({id(body): body for body in bodies}.values())
    number = {id(body): k for k, body in enumerate(unique)}
    return unique, [number[id(body)] for body in bodies]


def unfolded(garment: Any, body: Any, layers: Layers, materials: Materials, *starts: Any) -> Given:
    """Takes arguments apart that may hold outfits.

    Args:
        garment: A garment, a list of garments, an outfit, or a list of outfits.
        body: One for all garments, or one for each garment; of a list of outfits, one for each outfit. None where a
            list of outfits cannot be.
        layers: What is worn together; None, or True, for outfits, which say it themselves.
        materials: Materials of the garments; None for outfits that have their own.
        starts: For each garment an array, or nothing; of a list of outfits, a list for each.

    Raises:
        UsageError: An outfit, and `layers` or `materials` beside it that say it again; lists of other lengths; or a
            list of outfits and garments.
        ValueError, TypeError: As of `listed`.
    """
    if not isinstance(garment, Garment | Outfit):
        garment = list(garment)
    if isinstance(garment, Garment | Outfit) or not any(isinstance(item, Outfit) for item in garment):
        if isinstance(garment, Outfit):
            layers = _layers(layers, [garment])
            materials = _materials([garment], materials)
        garments, single = listed(garment, Garment)
        return Given(garments, single, body, layers, materials, starts)
    if not all(isinstance(item, Outfit) for item in garment):
        raise UsageError("a list of outfits and garments; make an outfit of each garment: wg.Outfit([garment])")
    if body is None:
        raise UsageError("start takes one outfit; give the garments of several as one list, with layers")
    outfits: list[Outfit] = garment
    sizes = tuple(len(outfit) for outfit in outfits)
    return Given(
        [item for outfit in outfits for item in outfit],
        False,
        _bodies(outfits, body),
        _layers(layers, outfits),
        _materials(outfits, materials),
        tuple(_flat(sizes, start) for start in starts),
        sizes,
    )


def _layers(layers: Layers, outfits: Sequence[Outfit]) -> Layers:
    """The garments of each outfit by their numbers."""
    if layers is False:
        return False  # nothing is kept apart
    if layers not in (None, True):
        raise UsageError("layers beside an outfit, which says itself what is worn over what; leave layers out")
    found, start = [], 0
    for outfit in outfits:
        found.append(list(range(start, start + len(outfit))))
        start += len(outfit)
    return found


def _materials(outfits: Sequence[Outfit], materials: Materials) -> Materials:
    """Materials of all garments; None if no outfit has any and none are given."""
    own = any(outfit.materials is not None for outfit in outfits)
    if materials is None:
        known = [outfit.materials or (None,) * len(outfit) for outfit in outfits]
        return [material for of_outfit in known for material in of_outfit] if own else None
    if own:
        raise UsageError("materials beside an outfit that has its own; leave one of them out")
    if len(outfits) > 1 and not isinstance(materials, Material):
        raise UsageError("materials of a list of outfits; give them to each: wg.Outfit(garments, materials)")
    return materials


def _bodies(outfits: Sequence[Outfit], body: Any) -> list[BodyMotion]:
    """The body of each garment. Outfits do not share one, so that networks do not take them for a single outfit."""
    bodies = [body] * len(outfits) if isinstance(body, BodyMotion) else list(body)
    if len(bodies) != len(outfits):
        raise UsageError(f"{len(outfits)} outfits and {len(bodies)} bodies; give one for each, or a single one for all")
    own = [copy.copy(item) if item in bodies[:number] else item for number, item in enumerate(bodies)]
    return [item for item, outfit in zip(own, outfits, strict=True) for _ in outfit]


def _flat(sizes: Sequence[int], start: Any) -> Any:
    """A list with one list for each outfit as one list."""
    if start is None:
        return None
    lists = [list(of_outfit) for of_outfit in start]
    if [len(of_outfit) for of_outfit in lists] != list(sizes):
        raise UsageError(
            f"outfits of {list(sizes)} garments, and first_vertices or history of {[len(item) for item in lists]}; "
            "give a list for each outfit, with an array for each garment"
        )
    return [array for of_outfit in lists for array in of_outfit]
