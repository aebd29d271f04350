"""The material of a garment's cloth."""

from __future__ import annotations

import difflib
import math
from dataclasses import asdict, dataclass
from numbers import Real

from warpgarment.errors import UsageError

EXAMPLES = {
    "density": "the mass per area in kg/m^2, such as 0.2",
    "stretch": "a stiffness in N/m, such as 1000",
    "shear": "a stiffness in N/m, such as 1000",
    "bend": "a moment per angle and length in N, such as 0.001",
    "damping": "a time in s, such as 1e-5",
    "friction": "a coefficient, such as 0.2",
}


@dataclass(frozen=True)
class Material:
    """One cloth, in SI units.

    `Material.cotton()`, `Material.preset("cotton")` and the like are fabrics of known figures; see `presets`.

    Attributes:
        density: Mass per area [kg/m^2].
        stretch: Resistance to change of area: first Lame parameter of the sheet [N/m].
        shear: Resistance to shear, and with it to stretch: second Lame parameter of the sheet [N/m].
        bend: Moment of a bent edge per angle and per length of the edge [N].
        damping: Damping of the membrane's rate of change, as a share of its shear stiffness [s].
        friction: Coulomb coefficient against the body and other cloth, without unit.

    Raises:
        UsageError: A number is negative or not finite, or one of the first three is 0.
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
            if not isinstance(value, Real) or not (math.isfinite(value) and float(value) >= least):
                raise UsageError(
                    f"a material's {name} must be {'positive' if least else 'at least 0'}, got {value}. Give "
                    f"{EXAMPLES[name]}"
                )

    @classmethod
    def preset(cls, name: str) -> Material:
        """A fabric by name, for example "denim"; `presets` has the names.

        Raises:
            UsageError: There is none of this name; the message says what there is.
        """
        if name not in _FABRICS:
            near = difflib.get_close_matches(name.lower(), _FABRICS, 1)
            meant = f" Did you mean {near[0]}?" if near else ""
            raise UsageError(f"no material {name!r}.{meant} There are {', '.join(_FABRICS)}")
        return _FABRICS[name][0]

    @classmethod
    def presets(cls) -> dict[str, str]:
        """Names of the fabrics, and of each what was measured, and where it is from.

        *Wang* is the database of Wang, O'Brien and Ramamoorthi, "Data-driven elastic models for cloth: modeling and
        measurement" (SIGGRAPH 2011), as it is distributed with the simulator ARCSim:

        - density as measured;
        - stretch = shear with stretch + 2 shear equal to the stiffness that was measured at 17 % extension, the mean of
          both threads and all five directions. Cloth that is stretched less is softer, its two threads differ up to
          fivefold, and it shears more easily than an isotropic sheet. The numbers are taken as N/m as they stand;
          ARCSim doubles them when it reads its files, so they may be low by a factor of two;
        - bend from the stiffness of the plate [N m] at the smallest curvature, the mean of the directions: on a mesh
          with edges of 34 mm, divided by √3/2 of those.

        *Blender* are the cloth presets of Blender 4.5, which are set for looks, not measured. They are converted as
        `warpgarment.training.materials` says, at scale 1 and with 1,000 vertices on a square metre.

        Friction and damping are in neither: they are the defaults, which are estimates.

        Density and stiffness lie in the ranges that the recipe `layers` trains on (0.2 to 0.8 kg/m^2, 191 to
        1,274 N/m, 0.001 to 0.98 N), except: `jersey` and `silk` are lighter; `jersey`, `rib`, `ponte` and `silk`
        stretch more easily; `silk` bends more easily. There a network extrapolates. Wool is not among them, for want of
        a source.
        """
        return {name: source for name, (_, source) in _FABRICS.items()}

    @classmethod
    def cotton(cls) -> Material:
        """Woven cloth of trousers, 65 % cotton and 35 % polyester: Wang's Royal Target, see `presets`."""
        return cls.preset("cotton")

    @classmethod
    def denim(cls) -> Material:
        """Denim of jeans, 99 % cotton, 11 oz: Wang's 11oz Black Denim, see `presets`."""
        return cls.preset("denim")

    @classmethod
    def jersey(cls) -> Material:
        """Knit of T-shirts, 60 % cotton and 40 % polyester: Wang's Gray Interlock, see `presets`."""
        return cls.preset("jersey")

    @classmethod
    def rib(cls) -> Material:
        """Rib knit of underwear, 95 % cotton: Wang's Ivory Rib Knit, see `presets`."""
        return cls.preset("rib")

    @classmethod
    def ponte(cls) -> Material:
        """Double knit of jackets, 60 % polyester and 40 % rayon: Wang's Camel Ponte Roma, see `presets`."""
        return cls.preset("ponte")

    @classmethod
    def silk(cls) -> Material:
        """Silk, an estimate for looks: Blender's preset, see `presets`."""
        return cls.preset("silk")

    @classmethod
    def leather(cls) -> Material:
        """Leather, an estimate for looks: Blender's preset, see `presets`."""
        return cls.preset("leather")

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


def _measured(density: float, stiffness: float, plate: float) -> Material:
    """Cloth by its mass per area [kg/m^2], its stiffness under extension λ + 2 μ [N/m], and that of its plate [N m]."""
    return Material(density, stiffness / 3.0, stiffness / 3.0, plate / _PER_HINGE)


_PER_HINGE = 0.5 * math.sqrt(3.0) * 0.034  # plate stiffness over bend on equilateral triangles with edges of 34 mm [m]
_FABRICS = {
    "cotton": (_measured(0.220, 2129.0, 189.4e-6), "woven, 65 % cotton, measured (Wang 2011, Royal Target)"),
    "denim": (_measured(0.324, 641.1, 53.5e-6), "99 % cotton, measured (Wang 2011, 11oz Black Denim)"),
    "jersey": (_measured(0.187, 213.9, 30.6e-6), "T-shirt, 60 % cotton, measured (Wang 2011, Gray Interlock)"),
    "rib": (_measured(0.276, 121.2, 74.2e-6), "rib knit, 95 % cotton, measured (Wang 2011, Ivory Rib Knit)"),
    "ponte": (_measured(0.284, 150.4, 40.0e-6), "double knit of jackets, measured (Wang 2011, Camel Ponte Roma)"),
    "silk": (Material(0.15, 63.7, 63.7, 4.9e-5), "Blender 4.5's preset, converted; not measured"),
    "leather": (Material(0.4, 1019.4, 1019.4, 0.147), "Blender 4.5's preset, converted; not measured"),
}
