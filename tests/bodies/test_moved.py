"""Files of bones as bodies: `wg.read_body("walk.bvh")`."""

from __future__ import annotations

import itertools
import json
import sys
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body, write_amass, write_bvh

import warpgarment as wg
from warpgarment.bodies import anny, moved
from warpgarment.cli import main
from warpgarment.errors import MissingExtra, UsageError

LEG, ARM = 40.0, 28.0  # lengths in the file's unit
SKELETON = [
    ("Hips", None, (0, 0, 0)), ("Spine", "Hips", (0, 20, 0)), ("Head", "Spine", (0, 40, 0)),
    *(
        joint
        for side, x in (("Left", 1), ("Right", -1))
        for joint in (
            (f"{side}UpLeg", "Hips", (9 * x, 0, 0)), (f"{side}Leg", f"{side}UpLeg", (0, -LEG, 0)),
            (f"{side}Foot", f"{side}Leg", (0, -LEG, 0)), (f"{side}Arm", "Spine", (15 * x, 30, 0)),
            (f"{side}ForeArm", f"{side}Arm", (ARM * x, 0, 0)), (f"{side}Hand", f"{side}ForeArm", (ARM * x, 0, 0)),
        )
    ),
]  # fmt: skip
TURN, STEP = 30.0, (100.0, 0.0, -50.0)  # of the root from the first frame to the second


def frames() -> list[list[float]]:
    """The T-pose at the origin; and turned about Y, a step away."""
    still = [0.0] * 3 * len(SKELETON)
    return [[0.0, 80.0, 0.0, *still], [STEP[0], 80.0, STEP[2], 0.0, 0.0, TURN, *still[3:]]]


@pytest.fixture
def walk(tmp_path):
    """A BVH file of two frames."""
    return write_bvh(tmp_path / "walk.bvh", SKELETON, frames(), fps=24.0)


def rigid(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation and translation that carry the first frame to the second, and the largest error [m] (Kabsch)."""
    a, b = vertices[0].astype(float), vertices[1].astype(float)
    turn, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
    shift = b.mean(0) - turn.apply(a.mean(0))
    return turn.as_matrix(), shift, float(np.abs(turn.apply(a) + shift - b).max())


@pytest.mark.parametrize("unit", [None, "cm", "in"])
def test_a_clip_moves_the_body_as_far_as_its_unit_says(walk, unit):
    """A body would be carried too far, or a unit be guessed in silence. A rigid motion of all bones, found again by
    Kabsch's algorithm, within 0.01 mm; without a unit the legs are as long as the body's."""
    legs = [rest_body().joint(f"Left{name}") for name in ("UpLeg", "Leg", "Foot")]
    fitted = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(legs)) / (2 * LEG)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        body = wg.read_body(walk, unit=unit)
    turn, shift, error = rigid(body.vertices)
    metres = {None: fitted, "cm": 0.01, "in": 0.0254}[unit]
    assert error < 1e-5
    np.testing.assert_allclose(turn, Rotation.from_euler("y", TURN, degrees=True).as_matrix(), atol=1e-5)
    np.testing.assert_allclose(shift, metres * np.array(STEP), atol=1e-5)
    assert body.fps == 24.0
    said = " ".join(str(warning.message) for warning in heard if warning.category is UserWarning)
    expected = {None: f"no unit. {fitted:.3g} m a unit", "cm": "", "in": "in another unit?"}[unit]
    assert (expected in said) if expected else not said
    assert body.source.metres == pytest.approx(metres)
    assert body.source.metres_from == ("by the legs" if unit is None else "given")
    np.testing.assert_allclose(np.quantile(body.vertices[:, :, 1].min(1), 0.05), 0.0, atol=1e-6)  # on the floor


@pytest.mark.parametrize("up", [None, "z"])
def test_a_file_with_z_up_is_the_same_body(tmp_path, walk, up):
    """A body would lie on its back. The same skeleton with its axes changed, within 0.01 mm."""
    lying = [(name, parent, (x, -z, y)) for name, parent, (x, y, z) in SKELETON]
    rows = [[x, -z, y, *turns] for x, y, z, *turns in frames()]
    rows[1][3:6] = [TURN, 0.0, 0.0]  # about Z
    file = write_bvh(tmp_path / "z.bvh", lying, rows, fps=24.0)
    with pytest.warns(UserWarning, match="no unit"):
        body, expected = wg.read_body(file, up=up), wg.read_body(walk)
    np.testing.assert_allclose(body.vertices, expected.vertices, atol=1e-5)
    assert body.source.up == "z"


def test_amass_is_in_metres_and_moves_the_same_body(tmp_path):
    """An archive of joint angles would be refused as one of positions, or lie on its back. All bones turn as one about
    Z, the file's vertical, which is Y here; 0.01 mm."""
    angle = np.radians(TURN)
    trans = np.array([[0.0, 0.0, 0.9], [0.3, -0.6, 0.9]])
    file = write_amass(tmp_path / "a.npz", {"pelvis": np.array([[np.pi / 2, 0, 0], [0, 0, 0]])}, 2, 60.0, trans=trans)
    poses = np.zeros((2, 52, 3))
    upright = Rotation.from_euler("x", 90, degrees=True)
    poses[:, 0] = [upright.as_rotvec(), (Rotation.from_rotvec([0, 0, angle]) * upright).as_rotvec()]
    file = write_amass(file, {}, 2, 60.0, trans=trans, poses=poses.reshape(2, -1))
    body = wg.read_body(file)
    turn, shift, error = rigid(body.vertices)
    assert error < 1e-5
    np.testing.assert_allclose(turn, Rotation.from_euler("y", angle).as_matrix(), atol=1e-5)
    assert (body.fps, body.source.metres, body.source.up) == (60.0, 1.0, "z")
    assert np.ptp(body.vertices[0, :, 1]) > 1.5  # it stands
    assert shift[2] > 0.5  # -Y of the file
    with pytest.raises(UsageError, match="AMASS motions are in metres"):
        wg.read_body(file, unit="cm")


def test_a_body_at_rest_is_the_one_that_moves(walk):
    """A garment would be modelled on another body than the one that is animated: vertices, order and faces are equal,
    and the body stands on the floor."""
    rest = wg.read_body(walk, rest=True)
    np.testing.assert_array_equal(rest.faces, rest_body().faces)
    np.testing.assert_allclose(rest.vertices[0], rest_body().vertices, atol=1e-6)


def test_a_shape_of_anny_is_another_body(walk):
    """A value of the shape space would be ignored, or the rest pose be that of another shape."""
    pytest.importorskip("anny", reason='the shape space is Anny\'s: pip install "warpgarment[bodies]"')
    with pytest.warns(UserWarning, match="no unit"):
        tall = wg.read_body(walk, "anny,height=0.8,gender=1")
    at_rest = wg.read_body(walk, "anny,height=0.8,gender=1", rest=True)
    expected = anny.anny_bodies().rest(height=0.8, gender=1.0)
    np.testing.assert_allclose(at_rest.vertices[0], expected.vertices, atol=1e-6)
    assert tall.vertices.shape[1] == len(expected.vertices)
    assert np.ptp(at_rest.vertices[0, :, 1]) > np.ptp(rest_body().vertices[:, 1])


def test_without_the_extra_anny_says_what_to_install(walk, monkeypatch):
    """The user would see that a module `anny` is missing."""
    monkeypatch.setitem(sys.modules, "anny", None)
    anny._load_anny.cache_clear()
    try:
        with pytest.raises(MissingExtra, match=r'pip install "warpgarment\[bodies\]"'):
            wg.read_body(walk, "anny,height=0.123")
    finally:
        anny._load_anny.cache_clear()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("annie", "'annie' is not known; there are bundled, anny"),
        ("anny,tall=1", "'tall=1' is no value of Anny's"),
        ("anny,height=2", "from 0 to 1"),
        ("anny,height", "'height' is no value"),
        ("SMPL_NEUTRAL.pkl", "pickled files run code"),
    ],
)
def test_a_body_that_is_not_there_is_refused(walk, shape, message):
    """A slip of the pen would give another body, or a fault of another library."""
    with pytest.raises(UsageError, match=message):
        wg.read_body(walk, shape)


def test_files_that_have_a_body_take_no_shape(tmp_path, walk):
    """A shape would be left out without a word where the file has a body of its own; bones of strangers are named."""
    still = tmp_path / "body.npz"
    wg.BodyMotion(rest_body().vertices[None], rest_body().faces).save(still)
    with pytest.raises(UsageError, match=r"body.npz has a body of its own\. shape= is for"):
        wg.read_body(still, "anny")
    assert wg.read_body(still, rest=True).frames == 1
    alien = write_bvh(tmp_path / "alien.bvh", [("a", None, (0, 0, 0)), ("b", "a", (0, 1, 0))], [[0.0] * 9])
    with pytest.raises(wg.MeshError, match=r"alien\.bvh: 9 bones have no joint in the clip .*Mixamo"):
        wg.read_body(alien)
    with pytest.raises(wg.MeshError, match=r"cannot read \.bvh as a mesh"):
        wg.Garment.load(walk)


def test_a_clip_too_long_for_memory_is_refused_before_it_is_posed(walk, monkeypatch):
    """A file of few megabytes would fill the memory."""
    monkeypatch.setattr(moved, "MOST", 3000)
    with pytest.raises(wg.MeshError, match=r"2 frames of 2,885 vertices are more than 3,000 positions. Cut the clip"):
        wg.read_body(walk)


def test_names_of_mixamo_are_understood(tmp_path, walk):
    """A character of Mixamo would be refused for the prefix of its bones; the body is the same, bit for bit."""
    named = [(f"mixamorig:{name}", parent and f"mixamorig:{parent}", at) for name, parent, at in SKELETON]
    file = write_bvh(tmp_path / "m.bvh", named, frames(), fps=24.0)
    np.testing.assert_array_equal(wg.read_body(file, unit="cm").vertices, wg.read_body(walk, unit="cm").vertices)


def test_commands_take_clips(tmp_path, walk, capsys):
    """`simulate dress.obj walk.bvh --fit-rest walk.bvh` and `--jobs` would refuse a clip, or dress another body: the
    same motion as with the body written out as positions, to 0.01 mm."""
    ring = rest_body().vertices, rest_body().faces
    waist = (np.abs(ring[0][:, 1] - 1.0) < 0.18) & (np.abs(ring[0][:, 0]) < 0.25)
    kept = waist[ring[1]].all(1)
    used, faces = np.unique(ring[1][kept], return_inverse=True)
    out = ring[0][used] * [1.12, 1.0, 1.12] + [0, 0, -0.12 * ring[0][used][:, 2].mean()]
    wg.Garment(out, faces.reshape(-1, 3)).save(tmp_path / "belt.obj")
    names = {name: str(tmp_path / name) for name in ("belt.obj", "rest.obj", "walk.npz", "a.npz", "b.npz", "c.npz")}
    bvh = str(walk)
    assert main(["convert", bvh, names["rest.obj"], "--rest"]) == 0
    assert main(["convert", bvh, names["walk.npz"], "--unit", "cm"]) == 0
    shared = ["--body-unit", "cm", "--out", names["a.npz"], "--frames", "2"]
    assert main(["simulate", names["belt.obj"], bvh, "--fit-rest", bvh, *shared]) == 0
    shared = ["--fit-rest", names["rest.obj"], "--out", names["b.npz"], "--frames", "2"]
    assert main(["simulate", names["belt.obj"], names["walk.npz"], *shared]) == 0
    job = {"garment": "belt.obj", "body": "walk.bvh", "fit_rest": "walk.bvh", "body_unit": "cm", "out": "c.npz"}
    (tmp_path / "jobs.jsonl").write_text(json.dumps(job | {"frames": 2, "body_shape": "bundled"}))
    assert main(["simulate", "--jobs", str(tmp_path / "jobs.jsonl")]) == 0
    expected = np.load(names["b.npz"])["vertices"]
    for name in ("a.npz", "c.npz"):
        np.testing.assert_allclose(np.load(names[name])["vertices"], expected, atol=1e-5)
    assert main(["info", bvh, "--unit", "cm"]) == 0
    assert "cm, given" in capsys.readouterr().out
    assert main(["convert", names["walk.npz"], names["rest.obj"], "--rest"]) == 2
    assert "has a body of its own" in capsys.readouterr().err
