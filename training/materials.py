"""What cloth is made of, in SI units, and how it is drawn at random.

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
life size. :func:`from_blender` says what they come to. The scaling is chosen, the rest derived from Blender's equations
and checked against it:

- *Scale.* Length shrinks by `scale`, a mass of one in Blender is a gram, gravity stays: the cloth sags and stretches
  under its own weight by the same share of its length, on a clock √scale times as fast. At scale 10 its weight per
  volume stays too. (Readers of recordings keep the clock and not the weight, see `readers.blender_cloth`.)
- *Mass* is per vertex, so density is mass times vertices over area, and the same numbers mean another cloth on another
  mesh: numbers belong to a mesh of so many vertices on so large an area.
- *Tension.* Edges are springs of stiffness tension / mean edge, in units of force that gravity fixes (0.00981 per frame
  squared: 1000 N). A net of such springs K on equilateral triangles is a sheet with λ = μ = √3/4 K. Derived; strips
  hung in Blender 4.5 stretch by what this says within 8 %.
- *Shear.* Blender has shear springs across faces of four corners only: triangle strips hang alike at shear 5 and 50.
  It is mapped as tension is, so that equal numbers give the isotropic net.
- *Bending.* A hinge of length L between triangles of height h turns back with 0.1 bending L h / 3 per radian. Derived;
  cantilevers bend by that within 12 %, as far as Blender brings them to rest.
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
"""Blender's numbers that D-LAYERS draws from."""

DLAYERS_SCALE = 10.0
"""How many times life size its garments are."""

VERTICES_PER_AREA = 1000.0
"""Of the mesh that its numbers are taken to belong to [1/m^2 at life size], edges of 34 mm: not published, but those of
the garments made here."""


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
    """The cloth that Blender's numbers stand for on a mesh of equilateral triangles; see the top of this file.

    Args:
        mass: Of a vertex.
        tension, shear, bending: Stiffnesses.
        compression: Left out: Newton's sheet resists it as it does tension.
        friction: 0 to 80.
        vertices: Number of the mesh's vertices.
        area: Of the mesh at life size [m^2].
        scale: How many times life size Blender's scene is.

    Returns:
        The material, at life size; Blender's damping is not mapped.
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
        material: At life size.
        vertices: Number of the mesh's vertices.
        area: Of the mesh at life size [m^2].
        scale: How many times life size Blender's scene is.

    Returns:
        mass, tension, compression (equal to tension), shear, bending and friction.
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
    """Edge of equilateral triangles, two to a vertex, that cover an area [m]."""
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
"""What :func:`sampled_material` draws from, SI: D-LAYERS' ranges, widened to hold the default material, which bends and
slides more easily (D-LAYERS bends like leather)."""


def sampled_material(rng: np.random.Generator) -> Material:
    """A cloth drawn at random: uniform over :data:`RANGES`, bending uniform in its logarithm."""
    drawn = {name: float(rng.uniform(*bounds)) for name, bounds in RANGES.items() if name != "bend"}
    low, high = RANGES["bend"]
    return Material(**drawn, bend=float(math.exp(rng.uniform(math.log(low), math.log(high)))))
