"""Which side of a body is outside. What is right is known from how the meshes are made."""

from __future__ import annotations

import warnings

import igl
import numpy as np
import pytest
import trimesh

import warpgarment as wg
from warpgarment.geometry.orientation import outward


def capsule() -> tuple[np.ndarray, np.ndarray]:
    """A closed capsule whose faces look outwards."""
    mesh = trimesh.creation.capsule(height=1.0, radius=0.2, count=[16, 16])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces).astype(np.int32)


def cup() -> tuple[np.ndarray, np.ndarray]:
    """A capsule without its upper third: open, faces outwards."""
    vertices, faces = capsule()
    return vertices, faces[vertices[faces].mean(1)[:, 2] < 0.4]


def two() -> tuple[np.ndarray, np.ndarray]:
    """Two capsules that overlap, as limbs do."""
    vertices, faces = capsule()
    return np.concatenate([vertices, vertices + [0.25, 0.0, 0.1]]), np.concatenate([faces, faces + len(vertices)])


SHAPES = {"closed": capsule, "open": cup, "overlapping": two}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_faces_are_turned_outwards_whichever_were_reversed(shape, share):
    """A body would keep faces that look inwards, or lose those that look outwards. Exact: corners up to rotation."""
    vertices, right = SHAPES[shape]()
    wrong = np.random.default_rng(0).random(len(right)) < share
    result = outward(vertices, np.where(wrong[:, None], right[:, ::-1], right))
    assert (result.turned == wrong).all()
    first = result.faces[np.arange(len(right)), (result.faces == right[:, :1]).argmax(1)]
    following = result.faces[np.arange(len(right)), ((result.faces == right[:, :1]).argmax(1) + 1) % 3]
    assert (first == right[:, 0]).all()
    assert (following == right[:, 1]).all()
    assert result.torn == 0
    assert result.pieces == (2 if shape == "overlapping" else 1)
    assert bool(result.message("a body")) == bool(wrong.any())


def test_far_from_the_origin():
    """Volumes would drown in rounding some kilometres away: the sign would be chance."""
    vertices, faces = capsule()
    far = vertices + np.array([20_000.0, 3.0, -40_000.0])
    assert not outward(far, faces).turned.any()
    assert outward(far, faces[:, ::-1]).turned.all()


def test_one_piece_of_two():
    """A piece that is inside out would be hidden by the volume of a larger one that is not."""
    vertices, faces = two()
    small = vertices.copy()
    small[len(vertices) // 2 :] *= 0.05
    half = len(faces) // 2
    mixed = faces.copy()
    mixed[half:] = mixed[half:, ::-1]
    result = outward(small, mixed)
    assert not result.turned[:half].any()
    assert result.turned[half:].all()
    assert result.inside_out == 1
    assert "1 of 2 pieces were inside out" in result.message("a body")


def test_a_flat_sheet_keeps_its_side():
    """A floor has no inside: turning it by the sign of a rounding error would be chance."""
    grid = trimesh.creation.box().subdivide()
    vertices, faces = np.asarray(grid.vertices), np.asarray(grid.faces).astype(np.int32)
    top = faces[(vertices[faces][..., 2] == 0.5).all(1)]
    for sheet in (top, top[:, ::-1]):
        result = outward(vertices, sheet)
        assert not result.turned.any()
        assert result.message("a floor") == ""


def test_a_moebius_strip_is_said():
    """A surface without two sides would be called right."""
    count = 24
    angle = np.arange(count) * 2 * np.pi / count
    rim = [
        np.stack([(1 + s * 0.2 * np.cos(angle / 2)) * np.cos(angle), (1 + s * 0.2 * np.cos(angle / 2)) * np.sin(angle),
                  s * 0.2 * np.sin(angle / 2)], 1)
        for s in (-1, 1)
    ]  # fmt: skip
    vertices = np.concatenate(rim)
    faces = []
    for i in range(count):
        a, b = i, i + count
        c, d = (i + 1, i + 1 + count) if i + 1 < count else (count, 0)
        faces += [[a, c, b], [b, c, d]]
    result = outward(vertices, np.array(faces, np.int32))
    assert result.torn > 0
    assert "cannot be made to agree" in result.message("a strip")


def test_a_body_says_what_was_turned():
    """A reversed body would be accepted in silence, or one that is right complained about."""
    vertices, faces = capsule()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body = wg.BodyMotion(vertices[None], faces)
    with pytest.warns(UserWarning, match=rf"{len(faces):,} of {len(faces):,} faces of the body looked inwards"):
        turned = wg.BodyMotion(vertices[None], faces[:, ::-1])
    corners = vertices[turned.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume > 0
    assert (np.sort(body.faces, 1) == np.sort(turned.faces, 1)).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once, not for every copy
        assert (turned.resampled(60.0).faces == turned.faces).all()
        turned.submesh(np.arange(len(faces)) < 40)


def test_depth_is_true_on_a_reversed_body():
    """Metrics would ask the same wrong sign as the rollout did: 0 mm deep inside a leg. Against libigl's distances."""
    vertices, faces = capsule()
    inside = np.array([[0.0, 0.0, 0.5], [0.15, 0.0, 0.5], [0.5, 0.0, 0.5]])
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    depth = -float(igl.signed_distance(inside, vertices, faces.astype(np.int64), kind)[0].min())
    with pytest.warns(UserWarning, match="looked inwards"):
        assert wg.metrics.max_penetration(inside, vertices, faces[:, ::-1]) == pytest.approx(depth, abs=1e-6)
    with pytest.warns(UserWarning, match="looked inwards"):
        assert wg.metrics.body_collision(inside, vertices, faces[:, ::-1]) == pytest.approx(2 / 3)


def test_a_few_faces_that_disagree_are_turned_round():
    """A garment with a few reversed faces, as of MakeHuman, would be refused, or mended in silence or wrongly."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces).astype(np.int32)
    flipped = faces.copy()
    flipped[[3, 50]] = flipped[[3, 50], ::-1]
    with pytest.warns(UserWarning, match=r"2 of 80 faces of garment 'suit' disagreed.*first: face 3"):
        garment = wg.Garment(vertices, flipped, name="suit")
    corners = garment.vertices[garment.faces].astype(np.float64)
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fi->f", outwards, corners.mean(1)) > 0).all()  # the sphere is about the origin
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (wg.Garment(vertices, faces[:, ::-1]).faces == faces[:, ::-1]).all()  # all reversed: as it was given
