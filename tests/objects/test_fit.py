"""If these failed, a garment would start its motion inside the body, torn, stretched, or left behind."""

import igl
import numpy as np
import pytest

import warpgarment as wg


def tube(radius, low, high, around=28, rows=14, caps=False):
    """A cylinder about the y axis, facing outwards; `caps` closes it with rounded ends."""
    angle = np.arange(around) * 2 * np.pi / around
    height = np.linspace(low, high, rows + 1)
    width = np.full(rows + 1, radius)
    if caps:
        width = radius * np.sqrt(np.clip(np.minimum(height - low, high - height) / radius, 0.02, 1))
    vertices = np.stack(
        [
            np.stack([w * np.cos(angle), 0 * angle + y, -w * np.sin(angle)], 1)
            for w, y in zip(width, height, strict=True)
        ]
    )
    k, i = np.divmod(np.arange(rows * around), around)
    a, b = k * around + i, k * around + (i + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    vertices = vertices.reshape(-1, 3)
    if caps:
        ring = np.arange(around)
        top = rows * around + ring
        faces = np.concatenate([
            faces,
            np.stack([np.full(around, len(vertices)), np.roll(ring, -1), ring], 1),
            np.stack([np.full(around, len(vertices) + 1), top, np.roll(top, -1)], 1),
        ])  # fmt: skip
        vertices = np.concatenate([vertices, [[0, low, 0], [0, high, 0]]])
    return vertices, faces


def bend(vertices, angle):
    """Bends the y axis into an arc in the x-y plane, over |y| < 0.25, straight beyond."""
    inside = np.clip(vertices[:, 1], -0.25, 0.25)
    turn = angle * (inside + 0.25) / 0.5
    curvature = angle / 0.5
    centre = np.stack([(1 - np.cos(turn)) / curvature, np.sin(turn) / curvature - 0.25, 0 * turn], 1)
    along = np.stack([np.sin(turn), np.cos(turn), 0 * turn], 1)
    across = np.stack([np.cos(turn), -np.sin(turn), 0 * turn], 1)
    beyond = (vertices[:, 1] - inside)[:, None]
    return centre + across * vertices[:, :1] + along * beyond + np.array([0, 0, 1.0]) * vertices[:, 2:]


def stretch(garment, vertices):
    i, j = garment.edges.T
    return (
        np.linalg.norm(vertices[i] - vertices[j], axis=1)
        / np.linalg.norm(garment.vertices[i] - garment.vertices[j], axis=1)
        - 1
    )


def signed_distance(points, vertices, faces):
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_WINDING_NUMBER
    return igl.signed_distance(points.astype(float), vertices.astype(float), faces.astype(np.int64), kind)[0]


BODY = tube(0.15, -0.7, 0.7, rows=40, caps=True)
GARMENT = wg.Garment(*tube(0.175, -0.45, 0.45))


def test_a_body_that_turns_and_shifts_carries_the_garment_exactly():
    """The garment would deform although nothing did. Tolerance 0.1 mm; float32 leaves less than 0.01."""
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([1.0, 2.0, -0.5])
    vertices, faces = BODY
    fitted = wg.fit(GARMENT, (vertices, faces), vertices @ rotation.T + shift)
    assert fitted.dtype == np.float32
    np.testing.assert_allclose(fitted, GARMENT.vertices @ rotation.T + shift, atol=1e-4)


@pytest.mark.parametrize("angle", [0.6, 1.4])
def test_a_bending_body_keeps_the_garment_outside_and_unstretched(angle):
    """The garment would start inside the body or torn at the bend. Signed distances are libigl's, in float64."""
    vertices, faces = BODY
    bent = bend(vertices, angle)
    fitted = wg.fit(GARMENT, (vertices, faces), bent)
    assert signed_distance(fitted, bent, faces).min() > 0.0039  # epsilon is 4 mm; float32 and facets take 0.1
    change = stretch(GARMENT, fitted)
    naive = stretch(GARMENT, bend(GARMENT.vertices.astype(float), angle))
    assert np.abs(change).mean() < 0.9 * np.abs(naive).mean()  # less stretch than bending it with space itself
    assert np.abs(change).max() < max(0.2, np.abs(naive).max())
    reference = bend(GARMENT.vertices.astype(float), angle)
    assert np.linalg.norm(fitted - reference, axis=1).mean() < 0.05  # it follows the bend


def test_a_skirt_between_two_legs_that_part_does_not_tear():
    """Vertices between the legs would jump to one or the other and tear the skirt along the middle."""
    leg, leg_faces = tube(0.07, -0.8, 0.1, rows=24, caps=True)
    rest = np.concatenate([leg + [0.1, 0, 0], leg - [0.1, 0, 0]])
    faces = np.concatenate([leg_faces, leg_faces + len(leg)])
    skirt_vertices, skirt_faces = tube(1.0, -0.6, 0.0, around=40, rows=10)
    skirt = wg.Garment(skirt_vertices * [0.22, 1, 0.13], skirt_faces)
    first = rest.copy()
    for side, part in ((1, slice(None, len(leg))), (-1, slice(len(leg), None))):
        c, s = np.cos(0.15), np.sin(0.15)
        turn = np.array([[c, -side * s, 0], [side * s, c, 0], [0, 0, 1]])
        first[part] = (rest[part] - [side * 0.1, 0.1, 0]) @ turn.T + [side * 0.1, 0.1, 0]
    fitted = wg.fit(skirt, (rest, faces), first)
    assert signed_distance(fitted, first, faces).min() > 0.0039
    change = stretch(skirt, fitted)
    assert np.abs(change).mean() < 0.08
    assert change.max() < 0.5


def test_motions_and_pairs_are_taken_alike():
    """A BodyMotion would be read at another frame than its first."""
    vertices, faces = BODY
    moved = vertices + [0, 1, 0]
    expected = wg.fit(GARMENT, (vertices, faces), moved)
    motion = wg.BodyMotion(np.stack([moved, vertices]), faces)
    np.testing.assert_array_equal(wg.fit(GARMENT, wg.BodyMotion(vertices[None], faces), motion), expected)
    np.testing.assert_array_equal(wg.fit(GARMENT, (vertices, faces), (moved, faces)), expected)


def test_two_different_bodies_are_refused():
    """Vertices of one body would be matched with those of another."""
    vertices, faces = BODY
    with pytest.raises(wg.MeshError, match="body_first"):
        wg.fit(GARMENT, (vertices, faces), vertices[:-1])
    with pytest.raises(wg.MeshError, match="different faces"):
        wg.fit(GARMENT, (vertices, faces), (vertices, faces[::-1]))
    with pytest.raises(wg.MeshError, match="body_rest"):
        wg.fit(GARMENT, vertices, vertices)
    with pytest.raises(wg.MeshError, match="NaN"):
        wg.fit(GARMENT, (vertices, faces), vertices * np.nan)


def test_no_epsilon_is_the_clearance_that_simulations_keep():
    """A coarse garment starts nearer to the body than its simulation keeps it, and jumps in the first frame. Against
    signed distances of libigl, to 0.1 mm: contacts of `fit` are soft, then moved out exactly, in float32."""
    coarse = wg.Garment(*tube(0.152, -0.45, 0.45, around=14, rows=7))
    i, j = coarse.edges.T
    edge = np.linalg.norm(coarse.vertices[i] - coarse.vertices[j], axis=1).mean()
    assert 0.2 * edge > 0.008, "coarse enough to matter"
    bent = bend(BODY[0], 0.5).astype(np.float32)
    free = wg.fit(coarse, BODY, bent, epsilon=None)
    assert signed_distance(free, bent, BODY[1]).min() > 0.2 * edge - 1e-4
    np.testing.assert_array_equal(wg.fit(coarse, BODY, bent), wg.fit(coarse, BODY, bent, epsilon=0.004))
    assert signed_distance(wg.fit(coarse, BODY, bent), bent, BODY[1]).min() < 0.2 * edge - 1e-3
