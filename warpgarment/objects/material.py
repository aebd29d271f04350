"""The material of a garment's cloth."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Material:
    """One cloth, in SI units.

    Attributes:
        density: Mass per area [kg/m^2].
        stretch: Resistance to change of area: first Lame parameter of the sheet [N/m].
        shear: Resistance to shear, and with it to stretch: second Lame parameter of the sheet [N/m].
        bend: Moment of a bent edge per angle and per length of the edge [N].
        damping: Damping of the membrane's rate of change, as a share of its shear stiffness [s].
        friction: Coulomb coefficient against the body and other cloth, without unit.
    """

    density: float = 0.2
    stretch: float = 1e3
    shear: float = 1e3
    bend: float = 1e-3
    damping: float = 1e-5
    friction: float = 0.2

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = 0.0 if name in ("bend", "damping", "friction") else 1e-9
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f"a material's {name} must be {'positive' if least else 'at least 0'}, got {value}")

    @property
    def modulus(self) -> float:
        """Young's modulus of the sheet [N/m]: tension per width over strain, 4 μ (λ + μ) / (λ + 2 μ)."""
        return 4.0 * self.shear * (self.stretch + self.shear) / (self.stretch + 2.0 * self.shear)

    @property
    def poisson(self) -> float:
        """Poisson's ratio of the sheet: its contraction across as a share of its extension along, without unit."""
        return self.stretch / (self.stretch + 2.0 * self.shear)

    def as_dict(self) -> dict[str, float]:
        """The attributes by name, in the units above, for a manifest."""
        return asdict(self)
