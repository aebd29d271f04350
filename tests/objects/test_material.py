"""Materials: presets are what their sources say, in units and ranges that are said."""

from __future__ import annotations

import numpy as np
import pytest

from warpgarment.errors import UsageError
from warpgarment.objects.material import Material
from warpgarment.training.materials import RANGES, from_blender

# Wang et al. 2011: density [kg/m^2]; stiffness along both threads [N/m] at 17 % extension in five directions, each
# thread summed; bending [N m] at the smallest curvature in five directions.
WANG = {
    "cotton": (
        0.220,
        [(2109.51684, 2173.93969), (2109.78002, 2155.51367), (2110.33349, 2135.0791), (2109.16015, 2124.13525)]
        + [(2109.52612, 2152.73852)],
        [125.409805, 167.284561, 215.41275, 215.09079, 223.861038],
    ),
    "denim": (
        0.324,
        [(232.027634, 1052.84289), (224.592209, 1054.43444), (225.95105, 1059.59741), (226.039566, 1058.27771)]
        + [(225.767487, 1051.55712)],
        [64.196457, 60.286175, 60.943428, 62.433697, 19.824701],
    ),
    "jersey": (
        0.187,
        [(46.364765, 261.013855), (49.28511, 206.373993), (123.98922, 365.966217), (139.686325, 413.553162)]
        + [(127.44381, 405.872833)],
        [23.191698, 32.932217, 34.406498, 39.01442, 23.382786],
    ),
    "rib": (
        0.276,
        [(52.422512, 245.337158), (29.482058, 127.130753), (91.209549, 109.746452), (48.973385, 147.696823)]
        + [(105.649139, 254.593491)],
        [46.237591, 63.086697, 83.192772, 97.574425, 80.726685],
    ),
    "ponte": (
        0.284,
        [(78.707756, 268.680725), (67.368431, 182.273407), (113.367035, 175.126572), (144.29483, 138.42215)]
        + [(143.933365, 191.777588)],
        [36.348366, 49.585537, 45.744080, 47.413387, 20.726685],
    ),
}
# mass of a vertex, tension (and shear), bending of the presets of Blender 4.5
BLENDER = {"silk": (0.15, 5.0, 0.05), "leather": (0.4, 80.0, 150.0)}
OUTSIDE = {
    "jersey": {"density", "stretch", "shear"},
    "rib": {"stretch", "shear"},
    "ponte": {"stretch", "shear"},
    "silk": {"density", "stretch", "shear", "bend"},
}


@pytest.mark.parametrize("name", WANG)
def test_measured_presets(name):
    """A digit or a unit of the measurements went wrong. Stiffness under extension and that of the plate on a mesh of
    34 mm edges, computed from the measured figures; 0.5 %, since the table is rounded."""
    density, along, bending = WANG[name]
    found = Material.preset(name)
    assert found.density == density
    assert found.stretch + 2 * found.shear == pytest.approx(np.mean(along), rel=5e-3)
    assert found.poisson == pytest.approx(1 / 3)
    assert found.bend * 0.034 * np.sqrt(3) / 2 == pytest.approx(1e-6 * np.mean(bending), rel=5e-3)


@pytest.mark.parametrize("name", BLENDER)
def test_presets_of_blender(name):
    """A preset would be another cloth than the training's conversion makes of Blender's numbers: to 0.5 %."""
    mass, tension, bending = BLENDER[name]
    expected = from_blender(mass, tension, tension, tension, bending, 20.0, vertices=1000, area=1.0, scale=1.0)
    assert Material.preset(name).as_dict() == pytest.approx(expected.as_dict(), rel=5e-3)


def test_presets_lie_in_the_ranges_of_the_training_data():
    """A network would be asked for a cloth it never saw, and nobody was told: what lies outside is in the docstring."""
    assert {*WANG, *BLENDER} == set(Material.presets())
    for name in Material.presets():
        found = Material.preset(name).as_dict()
        outside = {k for k, (low, high) in RANGES.items() if not low <= found[k] <= high}
        assert outside == OUTSIDE.get(name, set()), name
        assert getattr(Material, name)() == Material.preset(name)
        assert f"`{name}`" in Material.presets.__doc__ or not outside


def test_an_unknown_preset_is_told():
    """A user who mistypes a name would see a KeyError."""
    with pytest.raises(UsageError, match=r"no material 'coton'. Did you mean cotton.* There are cotton, denim,"):
        Material.preset("coton")
    assert Material(np.float32(0.3)).density == np.float32(0.3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"density": -0.2}, "density must be positive, got -0.2. Give the mass per area in kg/m.2, such as 0.2"),
        ({"stretch": 0}, "stretch must be positive, got 0. Give a stiffness in N/m"),
        ({"bend": float("nan")}, "bend must be at least 0, got nan. Give a moment"),
        ({"friction": -1}, "friction must be at least 0, got -1. Give a coefficient"),
        ({"shear": float("inf")}, "shear must be positive, got inf"),
        ({"density": "0.2"}, "density must be positive, got 0.2"),
    ],
)
def test_materials_that_cannot_be_are_refused(values, message):
    """A network would get the logarithm of a negative number; the message has to say what to give."""
    with pytest.raises(UsageError, match=message):
        Material(**values)
