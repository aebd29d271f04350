"""Long rollouts: extended motions have no jumps, figures find what they are there to find, verdicts follow."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from support import sequences as synthetic_sequences

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.evaluate.measure import EvaluateConfig, evaluate
from warpgarment.training.tables.long_rollout import Limits, extended, figures, judged, there_and_back, walk
from warpgarment.training.tables.options import DataLacks, OptionMissing, TableOptions


def test_times_turn_round_without_a_jump():
    """The body would jump or stop dead: the shown time moves by at most a frame, its speed changes by at most 1/w a
    frame, and it visits both ends; forward passes show whole frames at full speed."""
    times, forward = there_and_back(50, 400, turn=12)
    speed = np.diff(times)
    assert times.min() >= 0.0
    assert times.max() <= 49.0
    assert (times.min(), times.max()) == (0.0, 49.0)
    assert np.abs(speed).max() <= 1.0 + 1e-12
    assert np.abs(np.diff(speed)).max() <= 1.0 / 12 + 1e-12
    np.testing.assert_array_equal(times[:43], np.arange(43))  # the recording itself, up to where it slows down
    assert forward[:43].all()
    whole = times[forward]
    np.testing.assert_array_equal(whole, whole.round())
    assert forward[50:].any()
    later = np.flatnonzero(forward[:-1] & forward[1:])
    np.testing.assert_allclose(speed[later], 1.0, atol=1e-12)
    assert (np.diff(times)[100:] < -0.99).any()  # and it does go back


def test_extended_bodies_show_recorded_frames_and_move_smoothly():
    """Frames in between are wrong: whole frames must be the recorded ones exactly, and those of a body on a cubic path,
    which a cubic spline reproduces, must lie on it (1e-5 m: float32)."""
    points, faces = (
        trimesh.creation.icosphere(subdivisions=1).vertices,
        trimesh.creation.icosphere(subdivisions=1).faces,
    )
    t = np.arange(24) / 24.0

    def path(time):
        return np.stack([time, time**2 - time, 0.5 * time**3], -1)

    body = BodyMotion((points[None] + path(t)[:, None]).astype(np.float32), faces, 30.0)
    motion, times, forward = extended(body, 120, turn=6)
    assert motion.frames == 120
    np.testing.assert_array_equal(motion.vertices[forward], body.vertices[times[forward].astype(int)])
    np.testing.assert_allclose(motion.vertices, points[None] + path(times / 24.0)[:, None], atol=1e-5)
    with pytest.raises(ValueError, match="3 frames"):
        extended(BodyMotion(body.vertices[:3], faces, 30.0), 10)


def rigid_scene(frames: int = 90, move=None):
    """A tube that is carried rigidly by a capsule that turns and travels, and what it does on top of that."""
    content = synthetic_sequences.arrays(frames=2, pins=6)
    garment = Garment(content["garment_rest_vertices"], content["garment_faces"], pins=content["pins"])
    rest = content["body_rest_vertices"].astype(np.float64)
    cloth = garment.vertices.astype(np.float64)
    body, worn = [], []
    for t in range(frames):
        rotation = Rotation.from_euler("y", 0.5 * np.sin(0.2 * t)).as_matrix()
        shift = np.array([0.03 * t, 0.0, 0.02 * np.sin(0.3 * t)])
        body.append(rest @ rotation.T + shift)
        worn.append((cloth if move is None else move(cloth, t)) @ rotation.T + shift)
    motion = BodyMotion(np.array(body, np.float32), content["body_faces"], 30.0)
    return garment, np.array(worn, np.float32), motion


def test_a_garment_that_moves_like_its_body_is_good():
    """Something is found where nothing is: a garment rigid with its body has its mean where the anchor takes it
    (1e-4 m: float32 at 3 m), no stretch (1e-4) and no growth, and lies outside."""
    garment, worn, body = rigid_scene()
    found = figures(garment, worn[1:], worn[0], body, 1)
    assert found["mean_to_anchor_m"].max() < 1e-4
    assert np.abs(found["stretch"]).max() < 1e-4
    assert found["inside"].max() == 0.0
    assert np.isnan(found["mean_to_recording_m"]).all()
    verdict = judged(found)
    assert all(v["kept"] for v in verdict.values())
    assert verdict["energy_growth"]["value"] == pytest.approx(1.0, abs=0.2)


def test_drift_stretch_and_depth_are_measured():
    """A figure is wrong: a garment that slides up by 1 mm a frame, is squeezed by 1 in 30 and reaches 30 mm into the
    body at one vertex, against these numbers."""

    def move(cloth, t):
        moved = cloth + [0.0, 0.001 * t, 0.0]
        if t == 60:
            moved = moved.copy()
            moved[0] = [0.12, cloth[0, 1], 0.0]  # the capsule's radius is 0.15 m
        return moved

    garment, worn, body = rigid_scene(move=move)
    found = figures(garment, worn[1:], worn[0], body, 1)
    expected = 0.001 * np.arange(1, 90)
    expected[59] = np.nan
    np.testing.assert_allclose(np.delete(found["mean_to_anchor_m"], 59), np.delete(expected, 59), atol=2e-4)
    assert found["penetration_m"].argmax() == 59
    # the capsule has 12 sides: its flat parts lie up to 5 mm inside the circle
    assert found["penetration_m"][59] == pytest.approx(0.03, abs=0.006)
    assert found["inside"][59] == pytest.approx(1 / len(garment.vertices))
    i, j = garment.edges[(garment.edges == 0).any(1)].T
    rest = np.linalg.norm(garment.vertices[i] - garment.vertices[j], axis=1)
    now = np.linalg.norm(worn[60][i] - worn[60][j], axis=1)
    assert found["stretch"][59] == pytest.approx((now / rest).max() - 1.0, abs=1e-4)
    verdict = judged(found)
    kept = {name: v["kept"] for name, v in verdict.items()}
    assert not kept["mean_m"]
    assert not kept["penetration_m"]
    assert kept["inside"]
    # from where it was on average in the first 30 of 89 frames, 15.5 mm up, to the end
    assert verdict["mean_m"]["value"] == pytest.approx(0.089 - 0.0155, abs=1e-3)


def test_energy_is_that_of_the_motion_on_top_of_the_body():
    """Energy or its growth is wrong: a garment that vibrates vertically in the body's frame has the energy of a sine's
    finite differences on top of that of turning, and four times that when the amplitude doubles (10 %: the thirds are
    not whole periods)."""
    frames, rate = 121, 2 * np.pi / 10  # ten frames a period

    def shake(cloth, t):
        return cloth + [0.0, (0.02 if t <= 75 else 0.04) * np.sin(rate * t), 0.0]

    garment, worn, body = rigid_scene(frames, shake)
    found = figures(garment, worn[1:], worn[0], body, 1)
    turning = figures(garment, rigid_scene(frames)[1][1:], worn[0], body, 1)["energy"]
    vibrating = 0.25 * (30 * 0.02 * 2 * np.sin(rate / 2)) ** 2
    assert (found["energy"] - turning)[30:70].mean() == pytest.approx(vibrating, rel=0.1)
    growth = judged(found)["energy_growth"]
    assert growth["value"] == pytest.approx((turning.mean() + 4 * vibrating) / (turning.mean() + vibrating), rel=0.1)
    assert growth["value"] > 1.5
    assert not growth["kept"]


def test_a_rollout_that_fails_keeps_no_limit_it_did_not_reach():
    """A rollout that stopped being finite would be judged by the frames before."""
    garment, worn, body = rigid_scene()
    worn[40:] = np.nan
    verdict = judged(figures(garment, worn[1:], worn[0], body, 1))
    assert not any(v["kept"] for v in verdict.values())


def test_the_mean_is_judged_by_the_recording_where_there_is_one():
    """Distances from the recording are not those to it: a recorded mean 3 cm aside is kept, one 6 cm aside is not."""
    garment, worn, body = rigid_scene()
    areas = trimesh.Trimesh(garment.vertices, garment.faces, process=False)
    share = np.array([areas.area_faces[(areas.faces == v).any(1)].sum() for v in range(len(garment.vertices))])
    mean = np.einsum("v,tvc->tc", share / share.sum(), worn[1:])
    for aside, kept in ((0.03, True), (0.06, False)):
        recorded = mean + [0.0, aside, 0.0]
        recorded[::2] = np.nan
        verdict = judged(figures(garment, worn[1:], worn[0], body, 1, recorded))
        assert verdict["mean_m"]["value"] == pytest.approx(aside, abs=1e-4)
        assert verdict["mean_m"]["kept"] is kept
    assert Limits().mean_m == 0.05


def test_the_walk_goes_on_without_a_jump():
    """The procedural walk tears or stays on the spot: no vertex moves faster than 8 m/s or changes speed by more than
    3 m/s from frame to frame (feet strike), and the body gets 4 m away in 6 s."""
    body, place = walk(180)
    velocity = np.diff(body.vertices[:, ::40].astype(np.float64), axis=0) * body.fps
    assert np.linalg.norm(velocity, axis=-1).max() < 8.0
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=-1).max() < 3.0
    way = body.vertices[-1].mean(0) - body.vertices[0].mean(0)
    assert np.hypot(way[0], way[2]) > 4.0
    assert place.shape == (3, 4)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    torch.manual_seed(0)
    module = ManifoldAwareTransformer(NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2))
    path = tmp_path_factory.mktemp("network") / "skin.safetensors"
    checkpoint.save(module, path)
    return path


def test_long_rollouts_of_sequences(network, tmp_path):
    """Rollouts have another length, start or motion than they claim, or files are missing; recorded frames are compared
    with where they are shown: the first forward pass of a cold start against the error of `evaluate`'s own rollout."""
    folder = synthetic_sequences.write(tmp_path / "data", "one", "test", frames=16, pins=4)
    config = EvaluateConfig(
        data=tmp_path / "data", out=tmp_path / "out", network=str(network), table="long", device="cpu",
        tables=TableOptions(long_frames=24, garments=()),
    )  # fmt: skip
    result = evaluate(config)
    assert [(row["row"], row["start"]) for row in result["rows"]] == [("one", "warm"), ("one", "cold")]
    for row in result["rows"]:
        assert all(len(values) == 24 for values in row["curves"].values())
        assert row["finite_frames"] == 24
        assert row["good"] == all(v["kept"] for v in row["verdict"].values())
    shown = np.isfinite(result["rows"][0]["curves"]["mean_to_recording_m"])
    _, forward = there_and_back(16, 34)
    np.testing.assert_array_equal(shown, forward[10:])
    from warpgarment.sim.simulator import Simulator
    from warpgarment.training.rollouts import predict

    sequence = Sequence.load(folder)
    alone = predict(Simulator(checkpoint.load(network), "cpu"), sequence, 0, 5, cold=True)
    mesh = trimesh.Trimesh(sequence.garment.vertices, sequence.garment.faces, process=False)
    share = np.array([mesh.area_faces[(mesh.faces == v).any(1)].sum() for v in range(len(mesh.vertices))])
    off = np.einsum("v,tvc->tc", share / share.sum(), alone - sequence.vertices[1:6])
    expected = np.linalg.norm(off, axis=1)
    np.testing.assert_allclose(result["rows"][1]["curves"]["mean_to_recording_m"][:5], expected, atol=1e-5)
    assert sorted(p.name for p in config.out.iterdir()) == ["long.json", "long.md", "long.png"]
    saved = json.loads((config.out / "long.json").read_text())
    assert saved["limits"]["mean_m"] == 0.05
    assert "energy growth" in (config.out / "long.md").read_text()


def test_long_options_are_checked(tmp_path):
    """Nothing to roll out gives an empty table; an unknown garment a KeyError."""
    for tables, message in (
        (TableOptions(garments=()), "--data"),
        (TableOptions(garments=("cape",)), "no bundled garments cape"),
        (TableOptions(long_frames=1), "at least 3"),
    ):
        with pytest.raises(OptionMissing, match=message):
            evaluate(EvaluateConfig(table="long", tables=tables, picture=False))
    synthetic_sequences.write(tmp_path / "data", "one", "train", frames=12)
    with pytest.raises(DataLacks, match="no test sequence"):
        evaluate(EvaluateConfig(data=tmp_path / "data", table="long", tables=TableOptions(garments=()), picture=False))
