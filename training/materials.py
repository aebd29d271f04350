"""Material of cloth in SI units, its counterparts in Newton and Blender, and random materials.

| field     | Newton's VBD                                                         | Blender's cloth                  |
| --------- | -------------------------------------------------------------------- | -------------------------------- |
| density   | mass of a vertex: a third of its faces' area times this              | `mass`, the same for all vertices|
| stretch   | `tri_ka`, the first Lame parameter λ of a stable neo-Hookean sheet   | with shear: tension, compression |
| shear     | `tri_ke`, its second, the shear modulus μ                            | no counterpart on triangles      |
| bend      | `edge_ke`: an edge of length L resists bending with L bend θ²/2      | `bending_stiffness`              |
| damping   | `tri_kd` = damping · shear                                           | spring damping                   |
| friction  | against the body and between cloths: the mean of a scene's cloths    | friction / 100, one for all      |

Newton's sheet is isotropic: stretched along a line it resists with :attr:`Material.modulus` and contracts across by
:attr:`Material.poisson`; it resists compression as it does tension. Its bending is per hinge and depends on the mesh:
on equilateral triangles of edge e, bend makes a plate of stiffness √3/2 · bend · e [N m] (Seung and Nelson 1988).

**D-LAYERS** (Towards Multi-Layered 3D Garments Animation, supplement B.2) draws Blender's numbers uniformly: mass of a
vertex 0.2 to 0.8, tension, compression, shear and bending stiffness 15 to 100, friction 40 to 80, on garments ten times
life size. :func:`from_blender` converts them to SI units. The scaling is chosen; the rest is derived from Blender's
equations and checked against Blender:

- *Scale.* Length shrinks by `scale`, a mass of one in Blender is a gram, gravity does not change: the cloth sags and
  stretches under its own weight by the same share of its length, on a clock √scale times as fast. At scale 10 its
  weight per volume does not change either. (Readers of recordings keep the clock and not the weight; see
  `readers.blender_cloth`.)
- *Mass* is per vertex, so density is mass times the number of vertices over the area, and the same numbers describe
  another cloth on another mesh: they are meaningful only with the mesh's number of vertices and its area.
- *Tension.* Edges are springs of stiffness tension / mean edge, in units of force that gravity fixes (0.00981 per frame
  squared: 1000 N). A net of such springs K on equilateral triangles is a sheet with λ = μ = √3/4 K. This is derived;
  strips hung in Blender 4.5 stretch as predicted within 8 %.
- *Shear.* Blender has shear springs only across faces of four corners: triangle strips hang alike at shear 5 and 50.
  Shear is mapped as tension is, so that equal numbers give the isotropic net.
- *Bending.* A hinge of length L between triangles of height h turns back with 0.1 bending L h / 3 per radian. This is
  derived; cantilevers bend as predicted within 12 %, as far as Blender brings them to rest.
- *Compression* has no counterpart; :func:`to_blender` makes it equal to tension.
- *Friction* is a hundred times the coefficient.
"""

from __future__ import annotations

import math

import numpy as np

from warpgarment.objects.material import Material

DLAYERS = {
    "mass": (0.2, 0.8),
    "tension": (15.0, 100.0),
    "compression": (15.0, 100.0),
    "shear": (15.0, 100.0),
    "bending": (15.0, 100.0),
    "friction": (40.0, 80.0),
}
"""Ranges of Blender's numbers from which D-LAYERS draws."""

DLAYERS_SCALE = 10.0
"""Size of D-LAYERS' garments as a multiple of life size."""

VERTICES_PER_AREA = 1000.0
"""Density of vertices [1/m^2 at life size] of the mesh to which D-LAYERS' numbers are taken to belong: edges of 34 mm.
It is not published; this is the density of the garments made here."""


def from_blender(
    mass: float,
    tension: float,
    compression: float,
    shear: float,
    bending: float,
    friction: float,
    *,
    vertices: int,
    area: float,
    scale: float = DLAYERS_SCALE,
) -> Material:
    """The cloth that Blender's numbers describe on a mesh of equilateral triangles; see the top of this file.

    Args:
        mass: Mass of a vertex in Blender's unit.
        tension, shear, bending: Stiffnesses in Blender's units.
        compression: Stiffness against compression, which is ignored: Newton's sheet resists it as it does tension.
        friction: Friction in Blender's unit, 0 to 80.
        vertices: Number of vertices of the mesh.
        area: Area of the mesh at life size [m^2].
        scale: Size of Blender's scene as a multiple of life size.

    Returns:
        The material at life size in SI units; Blender's damping is not mapped.
    """
    del compression
    edge = _edge(vertices, area)
    return Material(
        density=1e-3 * mass * vertices / area,
        stretch=math.sqrt(3.0) / 4.0 * tension / edge,
        shear=math.sqrt(3.0) / 4.0 * shear / edge,
        bend=_BEND * bending * scale * edge,
        friction=0.01 * friction,
    )


def to_blender(material: Material, *, vertices: int, area: float, scale: float = DLAYERS_SCALE) -> dict[str, float]:
    """Blender's numbers for a cloth on a mesh: the inverse of :func:`from_blender`.

    Args:
        material: Material at life size.
        vertices: Number of vertices of the mesh.
        area: Area of the mesh at life size [m^2].
        scale: Size of Blender's scene as a multiple of life size.

    Returns:
        mass, tension, compression (equal to tension), shear, bending and friction by name, in Blender's units.
    """
    edge = _edge(vertices, area)
    tension = material.stretch * edge * 4.0 / math.sqrt(3.0)
    return {
        "mass": 1e3 * material.density * area / vertices,
        "tension": tension,
        "compression": tension,
        "shear": material.shear * edge * 4.0 / math.sqrt(3.0),
        "bending": material.bend / (_BEND * scale * edge),
        "friction": 100.0 * material.friction,
    }


_BEND = 0.1 / 3.0 * math.sqrt(3.0) / 2.0  # Blender's 0.1 h / 3 over the edge, h = √3/2 edge


def _edge(vertices: int, area: float) -> float:
    """Edge length of equilateral triangles, two per vertex, that cover an area [m]."""
    return math.sqrt(2.0 * area / (math.sqrt(3.0) * vertices))


def _ranges() -> dict[str, tuple[float, float]]:
    low, high = (
        from_blender(**{k: v[end] for k, v in DLAYERS.items()}, vertices=int(VERTICES_PER_AREA), area=1.0)
        for end in (0, 1)
    )
    ordinary = Material()
    names = ("density", "stretch", "shear", "bend", "friction")
    return {n: (min(getattr(low, n), getattr(ordinary, n)), getattr(high, n)) for n in names}


RANGES = _ranges()
"""Ranges from which :func:`sampled_material` draws, in SI units: D-LAYERS' ranges, widened to include the default
material, which bends and slides more easily (D-LAYERS bends like leather)."""


def sampled_material(rng: np.random.Generator) -> Material:
    """A cloth drawn at random: uniform over :data:`RANGES`, bending uniform in its logarithm."""
    drawn = {name: float(rng.uniform(*bounds)) for name, bounds in RANGES.items() if name != "bend"}
    low, high = RANGES["bend"]
    return Material(**drawn, bend=float(math.exp(rng.uniform(math.log(low), math.log(high)))))


FABRICS = ("cotton", "denim", "jersey", "rib", "ponte")
"""The presets of :class:`Material` whose figures were measured."""
SPREAD = 0.2
"""Deviation of the logarithm of a fabric's figures about those that were measured."""


def sampled_fabric(rng: np.random.Generator) -> Material:
    """A cloth like one of the measured fabrics: density, stiffness and bending differ from it by some 20 %, friction is
    uniform from 0.2 to 0.5, which no source has."""
    like = Material.preset(FABRICS[int(rng.integers(len(FABRICS)))])
    density, stiff, bend = np.exp(rng.normal(0.0, SPREAD, 3)).tolist()
    return Material(
        like.density * density,
        like.stretch * stiff,
        like.shear * stiff,
        like.bend * bend,
        friction=float(rng.uniform(0.2, 0.5)),
    )
