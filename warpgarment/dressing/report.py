"""What was done to dress a garment, and how well it lies: as a table, and as plain values for JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from warpgarment.geometry.over import is_wrong
from warpgarment.view.report import table

DEEP = 2e-3
"""Depth in the body [m] beyond which a garment is not well dressed."""
STRETCHED = 0.15
"""99th percentile of the stretch beyond which it is not."""


@dataclass(frozen=True)
class DressReport:
    """What was done, and what came of it.

    Attributes:
        garment: Name of the garment.
        kind: What it was taken for: shirt, jacket, trousers, overall or tube.
        openings: Length of each opening at rest [m].
        widths: Length of each opening over the girth of the body there.
        unit: Unit of the garment's numbers.
        unit_from: "given", "from the file", "assumed" or "guessed"; `up_from` is alike.
        up: Axis of the garment's numbers that points up.
        up_from: Where that comes from.
        scale: Metres in a number of the garment.
        resized: Change of size beyond the unit.
        turned: Turn about the vertical [degrees].
        moved: How far the middle of the garment was moved along X, Y and Z, in metres, after unit and axis.
        limbs: Largest turn of the limbs that followed sleeves and legs meanwhile [degrees].
        thin: How far the body was thinned, as a share of the whole flow: 0 is the body itself.
        stretch: Percentiles of the stretch of edges: 1, 50, 99, and the largest.
        deepest: Depth of the deepest point of the garment in the body [m].
        body_crossings: Pairs of faces of garment and body that cross.
        crossings: Pairs of faces of the garment that cross.
        crossings_before: The same as the garment came.
        pins: Number of pinned vertices.
        pins_from: Where they are from.
        notes: What was guessed and what to look at, in sentences.
        steps: Number of steps of the physics.
        seconds: How long it took [s].
    """

    garment: str
    kind: str
    openings: dict[str, float]
    widths: dict[str, float]
    unit: str
    unit_from: str
    up: str
    up_from: str
    scale: float
    resized: float
    turned: float
    moved: tuple[float, float, float]
    limbs: float
    thin: float
    stretch: tuple[float, float, float, float]
    deepest: float
    body_crossings: int
    crossings: int
    crossings_before: int
    pins: int
    pins_from: str
    notes: tuple[str, ...]
    steps: int
    seconds: float

    @property
    def faults(self) -> tuple[str, ...]:
        """What is not as it should be, in words; empty for a garment that lies well."""
        found = []
        if self.deepest > DEEP:
            found.append(f"{1e3 * self.deepest:.1f} mm deep in the body")
        if self.body_crossings:
            found.append(f"{self.body_crossings:,} pairs of faces of garment and body cross")
        if self.crossings:
            found.append(f"{self.crossings:,} pairs of faces of the garment cross")
        if self.stretch[2] > STRETCHED:
            found.append(f"a hundredth of the edges is stretched by {100 * self.stretch[2]:.0f} % or more")
        return tuple(found)

    def values(self) -> dict[str, Any]:
        """The report as plain values, with `faults`."""
        return {**asdict(self), "faults": list(self.faults)}

    def __str__(self) -> str:
        low, middle, high, most = (f"{100 * share:.1f}" for share in self.stretch)
        moved = " ".join(f"{100 * way:.1f}" for way in self.moved)
        widths = ", ".join(f"{name} {width:.2f}" for name, width in self.widths.items())
        rows = [
            ["taken for", self.kind],
            ["openings over the body there", widths or "-"],
            ["unit", f"{self.unit}, {self.unit_from}"],
            ["up", f"{self.up.upper() or 'none of the axes'}, {self.up_from}"],
            ["size", "kept" if self.resized == 1.0 else f"times {self.resized:.3g}"],
            ["turned [degrees]", f"{self.turned:.0f}"],
            ["moved x, y, z [cm]", moved],
            ["limbs turned meanwhile, most [degrees]", f"{self.limbs:.0f}"],
            ["stretch 1st, 50th, 99th percentile, most [%]", f"{low}, {middle}, {high}, {most}"],
            ["deepest in the body [mm]", f"{1e3 * self.deepest:.1f}"],
            ["pairs that cross: with the body, its own", f"{self.body_crossings:,}, {self.crossings:,}"],
            ["pins", f"{self.pins:,} ({self.pins_from})" if self.pins else "none"],
            ["steps, seconds", f"{self.steps:,}, {self.seconds:.0f}"],
        ]
        text = table(["", self.garment or "garment"], rows)
        return "\n".join([text, *(f"note: {note}" for note in self.notes), *(f"fault: {f}" for f in self.faults)])


@dataclass(frozen=True)
class PairReport:
    """How two garments lie on each other.

    Attributes:
        inner: Name of the one that is given first.
        outer: Name of the other.
        crossings: Pairs of faces of both that cross.
        above: Vertices of the outer one that lie over the inner one.
        beneath: Vertices of the outer one that lie beneath it.
        vertices: Number of vertices of the outer one.
    """

    inner: str
    outer: str
    crossings: int
    above: int
    beneath: int
    vertices: int

    @property
    def faults(self) -> tuple[str, ...]:
        """What is not as it should be, in words."""
        found = []
        if self.crossings:
            found.append(f"{self.crossings:,} pairs of faces of {self.inner} and {self.outer} cross")
        if is_wrong(self.beneath, self.above, self.vertices):
            found.append(
                f"{self.outer} lies beneath {self.inner} at {self.beneath:,} of the {self.beneath + self.above:,} "
                "vertices where they are over each other"
            )
        return tuple(found)


@dataclass(frozen=True)
class OutfitReport:
    """What was done with several garments, and what came of it.

    Attributes:
        garments: The report of each, innermost first.
        pairs: How each two of them lie on each other.
    """

    garments: tuple[DressReport, ...]
    pairs: tuple[PairReport, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """What is not as it should be, in words, of garments and of pairs; empty for an outfit that lies well."""
        own = [f"{one.garment or 'garment'}: {fault}" for one in self.garments for fault in one.faults]
        return (*own, *(fault for pair in self.pairs for fault in pair.faults))

    def values(self) -> dict[str, Any]:
        """The report as plain values, with `faults`."""
        pairs = [{**asdict(pair), "faults": list(pair.faults)} for pair in self.pairs]
        return {"garments": [one.values() for one in self.garments], "pairs": pairs, "faults": list(self.faults)}

    def __str__(self) -> str:
        rows = [[p.inner, p.outer, f"{p.crossings:,}", f"{p.above:,}", f"{p.beneath:,}"] for p in self.pairs]
        head = ["inner", "outer", "pairs of faces that cross", "vertices over it", "vertices beneath it"]
        faults = [f"fault: {fault}" for pair in self.pairs for fault in pair.faults]
        return "\n".join(["\n\n".join([*map(str, self.garments), table(head, rows)]), *faults])
