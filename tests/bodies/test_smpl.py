"""Models of SMPL's family, beside their published equations written out one vertex at a time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import write_amass, write_bvh
from support.files.smpl import PARENTS, write_model

import warpgarment as wg
from warpgarment.bodies.amass import read_recorded
from warpgarment.bodies.smpl import SmplModel

COUNT = 60  # vertices of the model


def published(data: dict[str, np.ndarray], angles: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """Equations 2 to 10 of Loper et al. (2015) with 4x4 matrices, for one frame; angles [J,3], in the file's axes."""
    joints = len(data["J_regressor"])
    turns = [Rotation.from_rotvec(angle).as_matrix() for angle in angles]
    shaped = data["v_template"] + sum(data["shapedirs"][..., k] * b for k, b in enumerate(betas))
    places = data["J_regressor"] @ shaped
    entries = np.concatenate([(turn - np.eye(3)).reshape(-1) for turn in turns[1:]])
    bent = shaped + sum(data["posedirs"][..., k] * e for k, e in enumerate(entries))
    world: list[np.ndarray] = []
    for j in range(joints):
        own = np.eye(4)
        own[:3, :3] = turns[j]
        own[:3, 3] = places[j] - (places[PARENTS[joints][j]] if j else 0.0)
        world.append(world[PARENTS[joints][j]] @ own if j else own)
    out = np.zeros_like(bent)
    for v in range(len(bent)):
        for j in range(joints):
            back = np.eye(4)
            back[:3, 3] = -places[j]
            out[v] += data["weights"][v, j] * (world[j] @ back @ np.append(bent[v], 1.0))[:3]
    return out + trans


@pytest.mark.parametrize(("joints", "width"), [(24, 72), (52, 156), (55, 165)])
def test_a_model_takes_amass_as_it_is(tmp_path, joints, width):
    """A body of SMPL's family would be posed or shaped wrongly, or stand at another place. The published equations in
    float64, to 1e-5 m (positions are float32), with the file's Z as Y."""
    model, data = write_model(tmp_path / "model.npz", joints, COUNT)
    rng = np.random.default_rng(joints)
    poses, trans, betas = rng.normal(0, 0.4, (3, width)), rng.normal(0, 1, (3, 3)), rng.normal(0, 1, 10)
    file = write_amass(tmp_path / "a.npz", {}, 3, 30.0, poses=poses, trans=trans, betas=betas)
    body = wg.read_body(file, model)
    for frame in range(3):
        x, y, z = published(data, poses[frame].reshape(-1, 3), betas[:4], trans[frame]).T
        np.testing.assert_allclose(body.vertices[frame], np.stack([x, z, -y], 1), atol=1e-5)
    rest = wg.read_body(file, model, rest=True)
    shaped = data["v_template"] + data["shapedirs"] @ betas[:4]
    np.testing.assert_allclose(rest.vertices[0], shaped - [0, shaped[:, 1].min(), 0], atol=1e-5)


def test_fingers_of_smplh_move_those_of_smplx(tmp_path):
    """Jaw and eyes of SMPL-X would be turned by the fingers of an SMPL-H recording, whose shape is another space."""
    model, data = write_model(tmp_path / "model.npz", 55, COUNT)
    rng = np.random.default_rng(1)
    poses = rng.normal(0, 0.4, (1, 52, 3))
    file = write_amass(tmp_path / "a.npz", {}, 1, 30.0, poses=poses.reshape(1, -1), betas=np.ones(4))
    with pytest.warns(UserWarning, match="coefficients of shape are of SMPL-H, not of SMPL-X"):
        body = wg.read_body(file, model)
    angles = np.zeros((55, 3))
    angles[:22], angles[25:] = poses[0, :22], poses[0, 22:]
    x, y, z = published(data, angles, np.zeros(4), np.zeros(3)).T
    np.testing.assert_allclose(body.vertices[0], np.stack([x, z, -y], 1), atol=1e-5)


def test_a_model_follows_bvh(tmp_path):
    """A model would move with Anny's bones alone. With a root that turns, all vertices turn about it, within 1e-5 m."""
    model, _ = write_model(tmp_path / "model.npz", 24, COUNT)
    skeleton = [("Hips", None, (0, 0, 0)), ("Head", "Hips", (0, 50, 0))]
    for side, x in (("Left", 1), ("Right", -1)):
        skeleton += [(f"{side}UpLeg", "Hips", (9 * x, -5, 0)), (f"{side}Leg", f"{side}UpLeg", (0, -40, 0))]
        skeleton += [(f"{side}Foot", f"{side}Leg", (0, -40, 0)), (f"{side}Arm", "Hips", (15 * x, 40, 0))]
        skeleton += [
            (f"{side}ForeArm", f"{side}Arm", (28 * x, 0, 0)),
            (f"{side}Hand", f"{side}ForeArm", (25 * x, 0, 0)),
        ]
    still = [0.0] * 3 * len(skeleton)
    rows = [[0.0, 90.0, 0.0, *still], [0.0, 90.0, 0.0, 0.0, 0.0, 90.0, *still[3:]]]
    body = wg.read_body(write_bvh(tmp_path / "w.bvh", skeleton, rows), model, unit="cm")
    x, y, z = body.vertices[0].T
    np.testing.assert_allclose(body.vertices[1], np.stack([z, y, -x], 1), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.zeros((COUNT, 23))}, r"weights \[60, 23\] does not fit"),
        ({"f": np.array([[0, 1, 99]])}, "vertices beyond the 60"),
        ({"kintree_table": np.zeros((2, 24), np.int64) + 30}, "no tree in which parents come first"),
        ({"v_template": np.full((COUNT, 3), np.nan)}, "v_template .* does not fit"),
        ({"shapedirs": None}, "no array named 'shapedirs'"),
        ({"J_regressor": np.array([{}], dtype=object)}, "J_regressor.npy is not a readable plain array"),
    ],
)
def test_damaged_models_are_refused(tmp_path, change, message):
    """A damaged model would end in an error of NumPy, or pickled objects be read."""
    model, _ = write_model(tmp_path / "model.npz", 24, COUNT, **change)
    with pytest.raises(wg.MeshError, match=message):
        SmplModel.load(model)


def test_an_archive_of_something_else_is_no_body(tmp_path):
    """Any archive would be taken for a body."""
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    motion = write_amass(tmp_path / "a.npz", {}, 1)
    assert len(read_recorded(motion).betas) == 16
    with pytest.raises(wg.MeshError, match="is no body"):
        wg.read_body(motion, tmp_path / "x.npz")
    with pytest.raises(FileNotFoundError):
        wg.read_body(motion, tmp_path / "none.npz")
