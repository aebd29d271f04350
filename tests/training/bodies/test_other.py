"""Bodies for tests only: wrapping parts in one skin, the creature, and the bundled body."""

from __future__ import annotations

import sys

import igl
import numpy as np
import pytest
import trimesh
from support.bodies import rest_body

from warpgarment.bodies import skeleton
from warpgarment.bodies.anny import sampled_phenotype
from warpgarment.bodies.rest import PHENOTYPES, RestBody, bundled_body
from warpgarment.errors import MissingExtra
from warpgarment.training.bodies import other as other_bodies
from warpgarment.training.bodies.limb_clearance import resolve_clearance
from warpgarment.training.garments.make import make_garment
from warpgarment.training.garments.pattern import Pattern
from warpgarment.training.motions.procedural import procedural


@pytest.fixture(scope="module")
def creature() -> RestBody:
    return other_bodies.creature_body()


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def assert_closed(vertices: np.ndarray, faces: np.ndarray, euler: int) -> None:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    different, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(vertices) - len(different) + len(faces) == euler
    assert np.asarray(igl.facet_components(faces.astype(np.int64))[0]) == 1


def test_overlapping_parts_get_one_skin():
    """If this fails, the mannequin has inner walls or holes. Twin: two spheres' volume less that of their lens."""
    r, apart = 0.25, 0.3
    ball = trimesh.creation.icosphere(subdivisions=4, radius=r)
    far = ball.vertices + np.array([apart, 0.0, 0.0])
    vertices = np.concatenate([ball.vertices, far])
    faces = np.concatenate([ball.faces, ball.faces + len(far)])
    skin, triangles = other_bodies.wrapped(vertices, faces, closing=0.02, cell=0.025, wanted=1500)
    assert_closed(skin, triangles, euler=2)
    assert len(triangles) == pytest.approx(1500, rel=0.15)
    lens = np.pi * (4 * r + apart) * (2 * r - apart) ** 2 / 12
    assert volume(skin, triangles) == pytest.approx(2 * 4 / 3 * np.pi * r**3 - lens, rel=0.02)  # the crease is filled
    radius = np.minimum(np.linalg.norm(skin, axis=1), np.linalg.norm(skin - [apart, 0, 0], axis=1))
    assert np.abs(radius - r).max() < 0.02  # in the crease; elsewhere faces cut corners by
    assert np.quantile(np.abs(radius - r), 0.9) < 0.003


def test_gaps_between_parts_are_bridged():
    """If this fails, what the joints of the mannequin leave open falls off or leaves tunnels."""
    boxes = [trimesh.creation.box((0.3, 0.2, 0.2), trimesh.transformations.translation_matrix((x, 0, 0)))
             for x in (-0.16, 0.16)]  # fmt: skip
    both = trimesh.util.concatenate(boxes)
    narrow, _ = other_bodies.wrapped(both.vertices, both.faces, closing=0.02, cell=0.02, wanted=800)
    assert np.ptp(narrow[:, 0]) == pytest.approx(0.62, abs=0.02)
    wide, _ = other_bodies.wrapped(both.vertices, both.faces, closing=0.004, cell=0.008, wanted=800)
    assert np.ptp(wide[:, 0]) == pytest.approx(0.30, abs=0.02)  # the largest piece is one box


def test_the_creature_is_one_closed_body_that_is_skinned(creature):
    """If this fails, cloth falls into the test body, or parts of it stay behind when it moves."""
    assert_closed(creature.vertices, creature.faces, euler=2)
    assert volume(creature.vertices, creature.faces) > 0.02  # outwards
    assert len(creature.faces) == pytest.approx(6000, rel=0.15)
    lengths = np.linalg.norm(creature.vertices[creature.faces[:, 0]] - creature.vertices[creature.faces[:, 1]], axis=1)
    assert lengths.max() < 2.0 * np.median(lengths)
    np.testing.assert_allclose(creature.bone_weights.sum(1), 1.0, atol=1e-6)
    assert creature.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-12)
    x, y, z = creature.vertices.T
    tips = {"LeftHand": x, "RightHand": -x, "Head": y, "Tail": -z, "LeftToeBase": np.where(y < 0.15, z + 0.1 * x, -9.0)}
    for name, along in tips.items():
        assert creature.weight_of(name)[along.argmax()] > 0.5, name
    left, right = (creature.weight_of(f"{side}Arm") for side in ("Left", "Right"))
    assert left @ creature.vertices[:, 0] == pytest.approx(
        -(right @ creature.vertices[:, 0]), rel=0.05
    )  # one mesh, not two halves


def test_the_creature_can_be_dressed_and_walks(creature):
    """If this fails, held-out tests cannot be made on it: garments do not fit, or its walk cannot be used."""
    for category, loops in (("tshirt", 4), ("trousers", 3)):
        garment, _ = make_garment(creature, Pattern(category, faces=600))
        assert len(igl.boundary_loop_all(garment.faces.astype(np.int64))) == loops
        distance = igl.signed_distance(
            garment.vertices.astype(float), creature.vertices, creature.faces.astype(np.int64),
            sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
        )[0]  # fmt: skip
        assert distance.min() > 0.004
    walk = skeleton.blended_in(creature, procedural(creature, "walk", 40, seed=1), 20)
    assert not resolve_clearance(creature, walk).unresolved.any()
    frames, _ = skeleton.posed(creature, walk)
    lowest = frames[:, :, 1].min(1)
    assert -0.03 < lowest.min() < lowest.max() < 0.03
    stretch = np.linalg.norm(np.diff(frames[:, creature.faces[:, :2]], axis=2)[:, :, 0], axis=2)
    assert (stretch[-1] / stretch[0]).max() < 2.5  # skin at knees and hips, but no part that stays behind
    assert skeleton.mirrored(creature, walk).rotations.shape == walk.rotations.shape


def test_other_bodies_are_saved_and_loaded(creature, tmp_path):
    """If this fails, a body without Anny's shape parameters cannot be stored."""
    creature.save(tmp_path / "body.npz")
    again = RestBody.load(tmp_path / "body.npz")
    np.testing.assert_allclose(again.vertices, creature.vertices, atol=1e-6)  # stored as float32
    assert again.bone_names == creature.bone_names
    assert again.phenotype == {}


def test_without_the_extra_the_mannequin_says_what_to_install(monkeypatch):
    """If this fails, a missing package ends in a bare ImportError."""
    monkeypatch.setitem(sys.modules, "mannequin", None)
    other_bodies.mannequin_body.cache_clear()
    with pytest.raises(MissingExtra, match=r"warpgarment\[bodies\]"):
        other_bodies.mannequin_body()


def test_people_are_drawn_from_all_of_the_shape_space():
    """If this fails, all bodies look alike, or a sequence cannot be made again from its seed."""
    drawn = [sampled_phenotype(np.random.default_rng(seed)) for seed in range(60)]
    assert drawn[7] == sampled_phenotype(np.random.default_rng(7))
    values = {name: np.array([d[name] for d in drawn]) for name in PHENOTYPES}
    assert all(((v >= 0) & (v <= 1)).all() for v in values.values())
    women = values["gender"] > 0.5
    assert 15 < women.sum() < 45
    assert values["age"].min() < 0.6 < 0.9 < values["age"].max()
    assert values["weight"].min() < 0.2 < 0.8 < values["weight"].max()


def test_the_bundled_body_needs_nothing():
    """If this fails, data cannot be made without Anny."""
    body = bundled_body()
    assert len(body.faces) == 5766
    assert body is rest_body()
    assert set(body.phenotype) == set(PHENOTYPES)
