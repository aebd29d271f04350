"""If these failed, seams would open in a simulation, buttons be left behind, or vertices not come back as they came."""

from __future__ import annotations

import warnings

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.scenes import Failing, body, network, outfit, simulator, skirt, still, tube, walk
from warpgarment.errors import MeshError
from warpgarment.io.obj import obj_text
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.fit import fit
from warpgarment.objects.garment import Garment
from warpgarment.objects.status import Verdict

WHOLE = skirt()
COUNT = len(WHOLE.vertices)


def cut():
    """The skirt as two panels, the second one's vertices 0.1 mm away; arrays, and the skirt's vertex for each."""
    left = WHOLE.vertices[WHOLE.faces].mean(1)[:, 0] < 0
    vertices, faces, whole, base = [], [], [], 0
    for side in (left, ~left):
        used, local = np.unique(WHOLE.faces[side], return_inverse=True)
        vertices.append(WHOLE.vertices[used] + np.float32([0, 1e-4 * (base > 0), 0]))
        faces.append(local.reshape(-1, 3) + base)
        whole.append(used)
        base += len(used)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(whole)


def buttons(heights=(0.1, -0.1), away=0.004):
    """Diamonds of 1 cm on the side of the skirt that looks along +X: vertices and faces, numbered from 0."""
    vertices, faces = [], []
    for number, height in enumerate(heights):
        share = (0.3 - height) / 0.6
        radius = (0.19 + 0.11 * share) * np.cos(np.pi / 16) + away
        middle = np.array([radius * np.cos(np.pi / 16), height, radius * np.sin(np.pi / 16)])
        up, side = np.array([0.0, 0.01, 0.0]), np.array([-np.sin(np.pi / 16), 0.0, np.cos(np.pi / 16)]) * 0.01
        vertices.append(middle + np.stack([up, side, -up, -side]))
        faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + 4 * number)
    return np.concatenate(vertices), np.concatenate(faces)


def buttoned(**options):
    """The skirt with buttons, whose vertices come first, and the mask of these."""
    vertices, faces = buttons()
    riding = np.arange(len(vertices) + COUNT) < len(vertices)
    together = np.concatenate([faces, WHOLE.faces + len(vertices)])
    return Garment(np.concatenate([vertices, WHOLE.vertices]), together, name="buttoned", **options), riding


def test_joined_seams_are_simulated_once_and_all_vertices_come_back(tmp_path):
    """A seam would open, or the output have other vertices than the file. Exact: the uncut skirt, vertex by vertex."""
    vertices, faces, whole = cut()
    (tmp_path / "panels.obj").write_text(obj_text(vertices, faces))
    with pytest.warns(UserWarning, match=r"28 vertices on open borders lie at 14 places.* and are joined"):
        garment = Garment.load(tmp_path / "panels.obj", clean=True)
    np.testing.assert_array_equal(garment.vertices, vertices)
    np.testing.assert_array_equal(garment.faces, faces)
    assert garment.components[2] == 1
    motion = walk(5)
    result = simulator(network()).rollout(garment, motion)
    assert result.vertices.shape == (5, len(vertices), 3)
    np.testing.assert_array_equal(result.faces, faces)
    twin = garment.simulated.garment
    alone = simulator(network()).rollout(twin, motion)
    where = np.array([np.argmin(np.linalg.norm(twin.vertices - WHOLE.vertices[v], axis=1)) for v in whole])
    np.testing.assert_array_equal(result.vertices, alone.vertices[:, where])
    assert len(twin.vertices) == COUNT


def test_panels_that_are_not_joined_are_said():
    """A seam would open by centimetres with "OK"."""
    garment = Garment(*cut()[:2])
    with pytest.warns(UserWarning, match=r"28 vertices on open borders .* clean=True.* they open"):
        simulator(network()).rollout(garment, walk(2))
    assert garment.components[2] == 2


def test_pins_follow_their_vertices_through_a_seam():
    """A waistband of panels would hang loose, or another vertex be held. 0.2 mm: one panel is 0.1 mm higher."""
    vertices, faces, whole = cut()
    pins = np.flatnonzero(whole < 16)
    with pytest.warns(UserWarning, match="joined"):
        garment = Garment.cleaned_from(vertices, faces, pins=pins, keep=True)
    np.testing.assert_array_equal(garment.pins, pins)
    held = garment.simulated.garment
    assert len(held.pins) == 16
    np.testing.assert_allclose(held.vertices[held.pins][:, 1], 0.3, atol=2e-4)


def test_vertices_that_no_face_has_keep_their_place_in_the_order(tmp_path):
    """Vertices of the output would be numbered in another way than the file's, and its polygons be wrong."""
    stray = np.concatenate([WHOLE.vertices[:40], WHOLE.vertices[40:41] + np.float32(0.01), WHOLE.vertices[40:]])
    faces = np.where(WHOLE.faces >= 40, WHOLE.faces + 1, WHOLE.faces)
    (tmp_path / "stray.obj").write_text(obj_text(stray, faces))
    with pytest.raises(MeshError, match="1 of 113 vertices belong to no face"):
        Garment.load(tmp_path / "stray.obj")
    garment = Garment.load(tmp_path / "stray.obj", clean=True)
    result = simulator(still()).rollout(garment, walk(3))
    assert result.vertices.shape == (3, 113, 3)
    np.testing.assert_array_equal(
        np.delete(result.vertices, 40, axis=1), simulator(still()).rollout(WHOLE, walk(3)).vertices
    )
    assert np.linalg.norm(result.vertices[:, 40] - result.vertices[:, 41], axis=-1).max() < 0.02


def test_buttons_ride_and_the_cloth_does_not_notice():
    """Buttons would drift away, or change how the cloth moves.

    The cloth is exact. Under a rigid body it moves rigidly to 1 mm (see `test_simulator`), and a button to 2 mm.
    """
    garment, riding = buttoned()
    follows = simulator(ManifoldAwareTransformer(NetworkConfig.small(layers=1, embedding=16, feed_forward=16)))
    with pytest.warns(UserWarning, match=r"'buttoned' has 2 small loose pieces \(8 vertices"):
        result = follows.rollout(garment, walk(12))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain = follows.rollout(WHOLE, walk(12))
    np.testing.assert_array_equal(result.vertices[:, ~riding], plain.vertices)
    np.testing.assert_allclose(result.vertices[0], garment.vertices, atol=1e-7)
    for t in range(12):
        turned = Rotation.from_rotvec([0, 0.05 * t, 0]).apply(garment.vertices[riding])
        expected = turned + np.array([0.01 * np.sin(0.5 * t), 0, 0.01 * t])
        assert np.linalg.norm(result.vertices[t, riding] - expected, axis=1).max() < 2e-3, t
    sides = result.vertices[:, [0, 1, 2, 3]] - result.vertices[:, [1, 2, 3, 0]]
    np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), 0.01 * np.sqrt(2), atol=1e-6)


def test_batches_and_single_steps_carry_buttons_alike():
    """In a batch, buttons of one garment would be taken for another's, or `step` would leave them. Exact."""
    garment, riding = buttoned()
    other = outfit()
    motion = walk(4)
    with pytest.warns(UserWarning, match="loose"):
        alone = simulator(network()).rollout(garment, motion)
    together = simulator(network()).rollout([other, garment, WHOLE], motion)
    assert [m.vertices.shape[1] for m in together] == [len(other.vertices), len(riding), COUNT]
    made = simulator(network())
    state = made.start([other, garment, WHOLE], motion.vertices[0], motion.faces)
    for frame in range(4):
        state = made.step(state, motion.vertices[frame]) if frame else state
        for seen, motions in zip(state.vertices, together, strict=True):
            np.testing.assert_array_equal(seen, motions.vertices[frame])
    np.testing.assert_allclose(together[1].vertices, alone.vertices, atol=2e-5)  # as batches of plain garments do
    assert [s.max_penetration for s in state.status] == [m.status[3].max_penetration for m in together]


def test_first_frames_and_histories_come_back_as_given():
    """A button that the user draped, or that is in known frames, would jump to its place at rest."""
    garment, riding = buttoned()
    first = garment.vertices + np.float32([0, 0.01, 0])
    first[riding] += np.float32([0.002, 0, 0])
    made = simulator(network())
    with pytest.warns(UserWarning, match="loose"):
        result = made.rollout(garment, walk(3), first_vertices=first)
    np.testing.assert_allclose(result.vertices[0], first, atol=1e-7)
    frames = np.stack([garment.vertices + np.float32([0, 0, 0.01 * t]) for t in range(3)])
    frames[1, riding] += np.float32([0, 0.001, 0])
    result = made.rollout(garment, walk(5), history=frames)
    np.testing.assert_array_equal(result.vertices[:3], frames)
    assert np.isfinite(result.vertices).all()
    with pytest.raises(ValueError, match=r"must have shape \[120, 3\]"):
        made.rollout(garment, walk(3), first_vertices=WHOLE.vertices)


def test_how_deep_a_button_is_counts():
    """A button inside the body would be called OK. Compared with libigl's distance, to float32 rounding."""
    vertices, faces = buttons(away=-0.06)  # 6 cm inwards: in the limb, and too far from the cloth to ride
    together = np.concatenate([WHOLE.faces, faces + COUNT])
    cloth = Garment(np.concatenate([WHOLE.vertices, buttons()[0]]), together)
    first = np.concatenate([WHOLE.vertices, vertices]).astype(np.float32)
    wide = body(3)
    wide.vertices[:] *= np.float32([1.2, 1, 1.2])
    with pytest.warns(UserWarning, match="loose"):
        result = simulator(still()).rollout(cloth, wide, first_vertices=first)
    at, on, sides = first[COUNT:].astype(float), wide.vertices[0].astype(float), wide.faces.astype(np.int64)
    expected = -igl.signed_distance(at, on, sides)[0].min()
    assert expected > 0.012
    assert result.status[0].max_penetration == pytest.approx(expected, abs=1e-6)
    assert result.status[0].verdict is Verdict.PENETRATING
    state = simulator(still()).start(cloth, wide.vertices[0], wide.faces, first_vertices=first)
    assert state.status.max_penetration == pytest.approx(expected, abs=1e-6)


def test_fit_takes_buttons_along():
    """A button would stay where the body was. 2 mm: the fit of a rigidly moved body is exact to rounding."""
    garment, _ = buttoned()
    rest, moved = body(1), body(1, lambda t: (0.3, 0.1, -0.2), lambda t: (0.0, 1.0, 0.0))
    with pytest.warns(UserWarning, match="loose"):
        first = fit(garment, rest, moved)
    expected = Rotation.from_rotvec([0, 1.0, 0]).apply(garment.vertices) + [0.3, 0.1, -0.2]
    assert np.abs(first - expected).max() < 2e-3


def test_a_rollout_that_fails_ends_with_nan_and_no_other_error():
    """The end would be an error of linear algebra instead of a status."""
    garment, riding = buttoned()
    vertices, faces = garment.vertices, garment.faces
    broken = Garment(vertices, faces, name="skirt")
    with pytest.warns(RuntimeWarning, match="stopped"):
        result = simulator(network(Failing)).rollout(broken, walk(9))
    assert np.isnan(result.vertices[-1]).all()
    assert result.status[-1].verdict is Verdict.NOT_FINITE
    assert np.isfinite(result.vertices[-2, riding]).all()


def test_garments_of_several_large_pieces_stay_as_they_are():
    """A set of top and skirt would lose one of them to the other."""
    both = outfit()
    assert both.simulated.garment is both
    small = tube(12, 3, bottom=0.5, top=0.53, radius=(0.03, 0.03))  # a bracelet, far from the rest
    vertices = np.concatenate([both.vertices, small[0]])
    garment = Garment(vertices, np.concatenate([both.faces, small[1] + len(both.vertices)]))
    with pytest.warns(UserWarning, match="1 small piece not connected with the rest and too far"):
        assert garment.simulated.garment is garment


def test_buttons_ride_at_the_shots_own_frames():
    """Between the network's frames, buttons would stay behind, or the cloth be moved as if they were simulated.

    The contact stage moves cloth away from a body that swings. The cloth is exactly that of the skirt without buttons;
    buttons keep their size to 1e-6 m, and stay 2 to 10 mm from the cloth below, at 4 mm first.
    """
    swing = body(13, lambda t: (0.12 * np.sin(1.9 * t), 0, 0))
    shot = BodyMotion(swing.vertices, swing.faces, 24.0, start=1001 / 24)
    garment, riding = buttoned()
    with pytest.warns(UserWarning, match="2 small loose pieces"):
        result = simulator(still()).rollout(garment, shot, out_fps="body")
    plain = simulator(still()).rollout(WHOLE, shot, out_fps="body")
    np.testing.assert_array_equal(result.vertices[:, ~riding], plain.vertices)
    sides = result.vertices[:, [0, 1, 2, 3]] - result.vertices[:, [1, 2, 3, 0]]
    np.testing.assert_allclose(np.linalg.norm(sides, axis=-1), 0.01 * np.sqrt(2), atol=1e-6)
    for t in range(13):
        middles = result.vertices[t, riding].reshape(2, 4, 3).mean(1).astype(np.float64)
        distance = igl.point_mesh_squared_distance(middles, plain.vertices[t].astype(np.float64), WHOLE.faces)[0] ** 0.5
        assert ((distance > 0.002) & (distance < 0.01)).all(), t
