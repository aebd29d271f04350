"""Materials: what Blender's numbers come to, what is drawn, and that all of it can be simulated."""

from __future__ import annotations

import itertools
from dataclasses import replace

import igl
import numpy as np
import pytest
from support.cloth import stretch

from warpgarment.objects.material import Material
from warpgarment.training.generate.quality import Limits
from warpgarment.training.materials import DLAYERS, RANGES, from_blender, sampled_fabric, sampled_material, to_blender
from warpgarment.training.teachers import Cloth, ClothScene
from warpgarment.training.teachers.checks import hanging_sheet
from warpgarment.training.teachers.newton.teacher import NewtonTeacher

NUMBERS = {"mass": 0.3, "tension": 40.0, "compression": 40.0, "shear": 25.0, "bending": 20.0, "friction": 55.0}


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_blender_numbers_go_there_and_back(scale):
    """The two teachers would be given different cloth."""
    mesh = {"vertices": 1834, "area": 1.7, "scale": scale}
    material = from_blender(**NUMBERS, **mesh)
    assert to_blender(material, **mesh) == pytest.approx(NUMBERS, rel=1e-12)
    again = from_blender(**to_blender(material, **mesh), **mesh)
    assert again.as_dict() == pytest.approx(material.as_dict(), rel=1e-12)
    assert from_blender(**NUMBERS | {"compression": 90.0}, **mesh) == material  # has no counterpart


def lattice() -> tuple[np.ndarray, np.ndarray, float]:
    """A large patch of equilateral triangles of edge 1: vertices [V, 2], edges [E, 2], vertices per area."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(40), np.arange(40)))
    vertices = np.stack([i + 0.5 * j, np.sqrt(0.75) * j], 1)
    number = {(a, b): n for n, (a, b) in enumerate(zip(i, j, strict=True))}
    edges = [(number[a, b], number[a + x, b + y]) for a, b in number for x, y in ((1, 0), (0, 1), (-1, 1))
             if (a + x, b + y) in number]  # fmt: skip
    return vertices, np.array(edges), 1 / np.sqrt(0.75)


def test_tension_is_a_net_of_springs():
    """A garment with Blender's numbers would stretch otherwise than Blender's springs: their energy is summed here."""
    vertices, edges, per_area = lattice()
    edge, scale = 0.2, 10.0  # in Blender's scene, ten times life size
    equal = NUMBERS | {"shear": NUMBERS["tension"]}
    material = from_blender(**equal, vertices=1000, area=1000 * (edge / scale) ** 2 / per_area)
    directions = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    rng = np.random.default_rng(0)
    for _ in range(3):
        strain = rng.normal(size=(2, 2)) * 1e-4
        strain = (strain + strain.T) / 2
        extension = np.einsum("ei,ij,ej->e", directions, strain, directions) * edge
        # of a vertex: three springs; Blender's unit of force is 1000 N, a mass of one stands for a gram
        spring = NUMBERS["tension"] / edge * 1000.0 * 1e-3
        energy = 0.5 * spring * (extension**2).mean() * 3 * per_area / edge**2 * scale  # per life-size area
        sheet = 0.5 * material.stretch * np.trace(strain) ** 2 + material.shear * (strain**2).sum()
        assert energy == pytest.approx(sheet, rel=0.05)  # the patch has a rim, where edges are missing
    assert material.poisson == pytest.approx(1 / 3)
    assert material.modulus == pytest.approx(2 / np.sqrt(3) * NUMBERS["tension"] / (edge / scale))


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_mass_and_bending_are_those_of_the_mesh(scale):
    """A finer mesh of the same numbers would weigh or bend otherwise than in Blender."""
    vertices, area = 1500, 0.9
    material = from_blender(**NUMBERS, vertices=vertices, area=area, scale=scale)
    assert material.density * area == pytest.approx(vertices * NUMBERS["mass"] * 1e-3)  # grams
    edge = np.sqrt(2 * area / np.sqrt(3) / vertices)
    length, height = scale * edge, scale * edge * np.sqrt(0.75)
    moment = 0.1 * NUMBERS["bending"] * length * height / 3 * 1000.0  # in Blender's scene [N m]
    assert material.bend * edge == pytest.approx(moment * 1e-3 / scale)
    assert material.friction == 0.55


def test_modulus_and_poissons_ratio_are_those_of_the_sheet():
    """The checks of teachers would expect another stretch: a sheet is pulled here, free to contract across."""
    material = Material(stretch=300.0, shear=500.0)
    stiffness = np.array([[1300.0, 300.0], [300.0, 1300.0]])  # λ + 2 μ, λ
    along, across = np.linalg.solve(stiffness, [1.0, 0.0])
    assert material.modulus == pytest.approx(1.0 / along)
    assert material.poisson == pytest.approx(-across / along)


def test_ranges_hold_dlayers_and_the_default():
    """Sampled garments would not cover what they are compared with."""
    corners = [
        from_blender(**{k: v[end] for k, v in DLAYERS.items()}, vertices=1000, area=1.0) for end in (0, 1)
    ] + [Material()]  # fmt: skip
    for name, (low, high) in RANGES.items():
        values = [getattr(m, name) for m in corners]
        assert low == pytest.approx(min(values))
        assert high == pytest.approx(max(values))


def test_sampled_materials_are_a_function_of_the_seed():
    """Two runs of a seed would differ, or a draw lie outside of what was checked."""
    assert sampled_material(np.random.default_rng(3)) == sampled_material(np.random.default_rng(3))
    rng = np.random.default_rng(0)
    drawn = [sampled_material(rng) for _ in range(300)]
    for name, (low, high) in RANGES.items():
        values = np.array([getattr(m, name) for m in drawn])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    middle = np.sqrt(np.prod(RANGES["bend"]))
    assert np.mean([m.bend < middle for m in drawn]) == pytest.approx(0.5, abs=0.1)  # three standard deviations


def test_materials_that_cannot_be_are_refused():
    """A massless or NaN cloth would explode in the solver instead of naming itself."""
    with pytest.raises(ValueError, match="a material's density must be positive, got 0"):
        Material(density=0.0)
    with pytest.raises(ValueError, match="a material's bend must be at least 0, got nan"):
        Material(bend=float("nan"))
    assert Material(bend=0.0, friction=0.0).bend == 0.0


def test_the_extremes_of_the_ranges_can_be_simulated():
    """A sampled garment would explode, or be rejected by the gate for its material alone."""
    names = ("density", "stretch", "shear", "bend")
    edge = 0.034
    sheet = hanging_sheet(6 * edge, 6 * edge, edge)
    air = np.zeros((8, 3))
    air[:4, 2] = 8.0  # the strongest wind that is sampled, and its end
    scenes = [
        ClothScene((Cloth(sheet, edge, material=replace(Material(), **dict(zip(names, values, strict=True)))),),
                   frames=8, wind=air, settle=2)
        for values in itertools.product(*(RANGES[n] for n in names))
    ]  # fmt: skip
    assert len(scenes) == 16
    for frame in NewtonTeacher().simulate_many(scenes):
        vertices = np.stack(frame)
        assert np.isfinite(vertices).all()
        changed = np.abs(stretch(sheet, vertices))
        assert np.quantile(changed, 0.99, axis=1).max() < Limits().stretch / 2  # half of what the gate allows
        assert changed.max() < Limits().largest_stretch / 2
    assert igl.avg_edge_length(sheet.vertices.astype(float), sheet.faces) > 0.03  # as coarse as was said


def test_sampled_fabrics_are_near_measured_ones():
    """A set of "fabrics" would hold cloth that nobody wears, or one fabric only. Within four deviations."""
    rng = np.random.default_rng(3)
    drawn = [sampled_fabric(rng) for _ in range(200)]
    assert drawn[0] == sampled_fabric(np.random.default_rng(3))
    presets = {name: Material.preset(name) for name in ("cotton", "denim", "jersey", "rib", "ponte")}
    nearest = []
    for one in drawn:
        off = {
            name: max(abs(np.log(getattr(one, f) / getattr(two, f))) for f in ("density", "stretch", "shear", "bend"))
            for name, two in presets.items()
        }
        nearest.append(min(off, key=off.__getitem__))
        assert off[nearest[-1]] < 0.8
        assert 0.2 <= one.friction <= 0.5
    assert set(nearest) == set(presets)
