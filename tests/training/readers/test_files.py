"""Recordings put together from PC2, OBJ sequences, USD and NPZ; formats by content; recordings as training data."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from support.files.readers import QUADS, STRIP, TRIANGLES, moving, write_obj, write_point_cache, write_usda

from warpgarment.errors import MeshError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.data.sequence import Sequence, list_sequences
from warpgarment.training.readers import (
    RecordedGarment,
    Recording,
    detect,
    read_recording,
    recording,
    write_as_sequence,
)

FRAMES = 4
BODY = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, 1]], dtype=np.float64)
BODY_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def body_motion(frames: int = FRAMES, fps: float = 30.0) -> BodyMotion:
    return BodyMotion(np.tile(BODY, (frames, 1, 1)) + np.arange(frames)[:, None, None] / 100.0, BODY_FACES, fps)


def write_pc2(folder, name: str = "dress", frames: int = FRAMES, scale: float = 1.0):
    write_obj(folder / f"{name}.obj", scale * STRIP * 0.5, QUADS)
    write_point_cache(folder / f"{name}.pc2", scale * moving(STRIP, frames), "f")
    return folder / f"{name}.pc2"


def write_folder(folder, frames: np.ndarray, polygons):
    folder.mkdir()
    for t, frame in enumerate(frames):
        write_obj(folder / f"frame{t + 1}.obj", frame, polygons)  # frame10 comes after frame9
    return folder


def test_point_caches_of_garment_and_body(tmp_path):
    """If this fails, a PC2 animation comes out with other positions, or without the rest shape beside it."""
    write_obj(tmp_path / "body.obj", BODY, BODY_FACES)
    write_point_cache(tmp_path / "body.pc2", body_motion().vertices.astype(np.float64), "f")
    made = recording(write_pc2(tmp_path), tmp_path / "body.pc2", fps=25)
    np.testing.assert_array_equal(made.garments[0].vertices, moving(STRIP, FRAMES).astype(np.float32))
    np.testing.assert_array_equal(made.garments[0].rest.vertices, (STRIP * 0.5).astype(np.float32))
    np.testing.assert_array_equal(made.garments[0].rest.faces, TRIANGLES)
    np.testing.assert_array_equal(made.body.vertices, body_motion().vertices)
    assert (made.fps, made.body.fps, made.garments[0].rest.name) == (25.0, 25.0, "dress")
    assert (detect(tmp_path / "dress.pc2"), len(read_recording(tmp_path / "dress.pc2"))) == ("pc2", FRAMES)


def test_folders_of_obj_in_other_units(tmp_path):
    """If this fails, frames are out of order after the ninth, or centimetres are taken for metres."""
    folder = write_folder(tmp_path / "shirt", 100 * moving(STRIP, 11), TRIANGLES)
    write_obj(tmp_path / "rest.obj", 100 * STRIP, QUADS)
    made = recording(folder, body_motion(11), rest=tmp_path / "rest.obj", unit="cm")
    np.testing.assert_allclose(made.garments[0].vertices, moving(STRIP, 11), atol=1e-6)  # text of centimetres
    np.testing.assert_allclose(made.garments[0].rest.vertices, STRIP, atol=1e-6)
    assert detect(folder) == "obj"
    with pytest.warns(UserWarning, match=r"no rest shape: the first frame serves"):
        first = read_recording(folder, unit="cm")
    np.testing.assert_allclose(first.garments[0].rest.vertices, STRIP, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*no rest shape")
def test_meshes_of_one_usd_stage(tmp_path):
    """If this fails, a stage's axes, unit or rate are not understood, or garments mixed up."""
    inner, outer = 100 * moving(STRIP, FRAMES), 100 * moving(STRIP + [0, 0.1, 0], FRAMES)
    write_usda(tmp_path / "scene.usda", {"shirt": inner, "jacket": outer})
    stage = tmp_path / "scene.usda"
    made = recording([(stage, "shirt"), (stage, "/jacket")], body_motion(fps=24.0))
    for garment, frames in zip(made.garments, (inner, outer), strict=True):
        x, y, z = np.moveaxis(frames / 100, -1, 0)
        np.testing.assert_allclose(garment.vertices, np.stack([x, z, -y], axis=-1), atol=1e-6)
    assert [g.rest.name for g in made.garments] == ["shirt", "jacket"]
    assert (made.fps, detect(stage)) == (24.0, "usd")
    assert [g.rest.name for g in recording((stage, "jacket")).garments] == ["jacket"]
    with pytest.raises(MeshError, match=r"2 meshes: /shirt, /jacket. Name one"):
        recording(stage)


def starting(folder, name: str, frames: np.ndarray, start: float, mesh, polygons):
    """A point cache that starts at a frame."""
    write_obj(folder / f"{name}.obj", mesh, polygons)
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], start, 1.0, len(frames))
    (folder / f"{name}.pc2").write_bytes(head + np.ascontiguousarray(frames, "<f4").tobytes())
    return folder / f"{name}.pc2"


def test_files_that_start_at_other_frames_are_put_together_by_time(tmp_path):
    """If this fails, a dress is recorded on the body of another moment: frame k of both files, whatever k means."""
    cloth, under = moving(STRIP, 12), body_motion(12).vertices
    dress = starting(tmp_path, "dress", cloth[3:10], 1003, STRIP * 0.5, QUADS)
    whole = starting(tmp_path, "body", under, 1000, BODY, BODY_FACES)
    with pytest.warns(UserWarning, match=r"dress 1003 to 1009, body 1000 to 1011; the 7 frames from 1003 on are kept"):
        made = recording(dress, whole, fps=24)
    np.testing.assert_array_equal(made.garments[0].vertices, cloth[3:10].astype(np.float32))
    np.testing.assert_array_equal(made.body.vertices, under[3:10])
    shot = BodyMotion(under[:8], BODY_FACES, 24.0, start=1000 / 24)
    shot.save(tmp_path / "shot.npz")
    for body in (shot, tmp_path / "shot.npz"):
        with pytest.warns(UserWarning, match="the 5 frames from 1003 on are kept"):
            made = recording(dress, body, fps=24)
        np.testing.assert_array_equal(made.garments[0].vertices, cloth[3:8].astype(np.float32))
        np.testing.assert_array_equal(made.body.vertices, under[3:8])
    with pytest.raises(MeshError, match=r"no frame in common: dress 1003 to 1009, body 2000 to 2011"):
        recording(dress, starting(tmp_path, "later", under, 2000, BODY, BODY_FACES), fps=24)
    with pytest.raises(MeshError, match=r"lie between each other: dress 1003 to 1009, body 1000\.5 to"):
        recording(dress, starting(tmp_path, "half", under, 1000.5, BODY, BODY_FACES), fps=24)
    with pytest.warns(UserWarning, match="some files start at frame 1003, some at 0, with 7 frames"):
        made = recording(dress, starting(tmp_path, "zero", under[:7], 0, BODY, BODY_FACES), fps=24)
    assert len(made) == 7


def test_resampled_recordings_hold_no_frame(tmp_path):
    """If this fails, cloth is taught to stop at the end of each sequence: 24 frames at 24 a second last 28.75 of 30.

    Steps are alike to 1e-5 m: positions are float32, up to 17 m from the origin.
    """
    cloth = moving(STRIP, 24)
    made = recording(starting(tmp_path, "dress", cloth, 0, STRIP * 0.5, QUADS), body_motion(24, 24.0), fps=24)
    fast = made.resampled(30.0)
    assert (len(fast), len(fast.body), fast.fps) == (29, 29, 30.0)
    steps = np.linalg.norm(np.diff(fast.garments[0].vertices, axis=0), axis=-1)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*no rest shape")
def test_parts_that_do_not_fit_are_named(tmp_path):
    """If this fails, garment and body of other lengths, rates, units or places become one recording."""
    dress = write_pc2(tmp_path)
    with pytest.raises(MeshError, match=r"numbers of frames differ: garment dress 4, body 6. Cut them"):
        recording(dress, body_motion(6))
    BodyMotion(moving(STRIP, FRAMES), TRIANGLES, 24.0).save(tmp_path / "coat.npz")
    with pytest.raises(MeshError, match=r"frames per second differ: coat.npz 24, body 30"):
        recording(tmp_path / "coat.npz", body_motion())
    assert recording(tmp_path / "coat.npz", body_motion(), fps=60).body.fps == 60.0
    assert (detect(tmp_path / "coat.npz"), recording(tmp_path / "coat.npz").fps) == ("npz", 24.0)
    with pytest.raises(MeshError, match=r"'dress' is 7\.5 m and the body 1\.5 m in size: one of them is in another"):
        recording(write_pc2(tmp_path, scale=15.0), body_motion())
    far = body_motion().vertices + np.float32(50)
    with pytest.raises(MeshError, match=r"starts 8\d.\d m from the body: they are in other places"):
        recording(write_pc2(tmp_path), BodyMotion(far, BODY_FACES))
    with pytest.raises(MeshError, match="2 rest shapes for 1 garments"):
        recording(dress, rest=[dress, dress])
    with pytest.raises(MeshError, match="1 materials for 2 garments"):
        recording([dress, dress], materials=[Material()])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        recording(tmp_path / "nowhere.pc2")


@pytest.mark.filterwarnings("ignore:.*no rest shape")
def test_rest_shapes_of_other_meshes_are_refused(tmp_path):
    """If this fails, a garment's rest shape and motion have their vertices or faces in another order."""
    folder = write_folder(tmp_path / "shirt", moving(STRIP, FRAMES), TRIANGLES)
    write_obj(tmp_path / "few.obj", STRIP[:4], QUADS[:1])
    with pytest.raises(MeshError, match=r"few.obj has 4 vertices, .*shirt 6"):
        recording(folder, rest=tmp_path / "few.obj")
    write_obj(tmp_path / "other.obj", STRIP, [[0, 1, 5], [1, 2, 5], [2, 4, 5], [0, 5, 3]])
    with pytest.raises(MeshError, match="have other faces: they must share one topology"):
        recording(folder, rest=tmp_path / "other.obj")


def test_damaged_animations_are_named(tmp_path):
    """If this fails, a truncated or broken cache is read as a shorter or wrong animation."""
    dress = write_pc2(tmp_path)
    dress.write_bytes(dress.read_bytes()[:-8])
    with pytest.raises(MeshError, match=r"dress.pc2: 312 bytes where 4 samples of 6 points need 320"):
        recording(dress)
    frames = moving(STRIP, FRAMES)
    frames[2] = np.inf
    write_point_cache(dress, frames, "f")
    with pytest.raises(MeshError, match=r"dress.pc2: 1 of 4 frames of dress hold NaN or infinity \(frames 2\)"):
        recording(dress)
    write_point_cache(dress, moving(STRIP[:5], FRAMES), "f")
    with pytest.raises(MeshError, match=r"5 points and dress.obj 6 vertices"):
        recording(dress)


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.pkl", b"\x80\x04}."), ("b.bin", b"what is this"), ("c.npz", None), ("folder", b"[[]]"), ("d.mp4", b"")],
)
def test_what_is_not_a_recording_is_not_guessed(tmp_path, name, content):
    """If this fails, some file is read in a format that it is not in."""
    path = tmp_path / name
    if content is None:
        np.savez(path, something=np.zeros(3))
    elif name == "folder":
        path.mkdir()
        (path / "meta.json").write_bytes(content)
    else:
        path.write_bytes(content)
    with pytest.raises(MeshError, match=r"not recognised\. Known are the folder of a CLOTH3D sample"):
        read_recording(path)
    with pytest.raises(MeshError, match="the format 'fbx' is not known; there are cloth3d, vto, dlayers"):
        read_recording(path, format="fbx")
    with pytest.raises(FileNotFoundError, match="No such file"):
        detect(tmp_path / "missing")


def test_amass_motions_are_recognised(tmp_path):
    """If this fails, a motion is taken for a recording of clothes."""
    np.savez(tmp_path / "walk_poses.npz", poses=np.zeros((5, 156)), trans=np.zeros((5, 3)), mocap_framerate=120.0)
    assert detect(tmp_path / "walk_poses.npz") == "amass"
    with pytest.raises(MeshError, match=r"it moves a body and has no garment.*read_amass"):
        read_recording(tmp_path / "walk_poses.npz")


def outfit(**changes) -> Recording:
    """Two garments on a body in the wind."""
    inner = RecordedGarment(Garment(STRIP, TRIANGLES, pins=[1], name="Shirt"), np.float32(moving(STRIP, FRAMES)))
    start = STRIP[:4] + [0, 0.1, 0]
    outer = RecordedGarment(Garment(start, TRIANGLES[:2], pins=[3], name="Jacket"), np.float32(moving(start, FRAMES)))
    parts = {"body": body_motion(), "materials": (Material(), None), "wind": np.ones((FRAMES, 3)), "source": "here"}
    return Recording((inner, outer), **(parts | changes))


def test_recordings_become_training_sequences(tmp_path):
    """If this fails, networks train on something else than was recorded.

    Positions are stored in 65,535ths of a frame's bounding box, here at most 2.3 m: 0.02 mm.
    """
    made = outfit(attributes={"motion": "clip 7"})
    collider = np.array([True, True, True, False])
    folder = write_as_sequence(made, tmp_path / "00001_outfit", split="test", collider=collider, extra={"subject": 3})
    assert list_sequences(tmp_path, split="test") == [folder]
    sequence = Sequence.load(folder)
    whole = np.concatenate([g.vertices for g in made.garments], axis=1)
    np.testing.assert_allclose(sequence.vertices, whole, atol=2e-5)
    np.testing.assert_array_equal(sequence.garment.vertices, np.concatenate([g.rest.vertices for g in made.garments]))
    np.testing.assert_array_equal(sequence.garment.faces, np.concatenate([TRIANGLES, TRIANGLES[:2] + 6]))
    np.testing.assert_array_equal(sequence.garment.pins, [1, 9])
    np.testing.assert_allclose(sequence.full_body().vertices, made.body.vertices, atol=2e-5)
    np.testing.assert_array_equal(sequence.full_body().faces, BODY_FACES)
    assert len(sequence.body().faces) == 3
    np.testing.assert_array_equal(sequence.wind, made.wind)
    assert [layer.name for layer in sequence.layers] == ["Shirt", "Jacket"]
    assert [layer.vertices for layer in sequence.layers] == [slice(0, 6), slice(6, 10)]
    manifest = sequence.manifest
    assert (manifest["motion"], manifest["subject"], manifest["frames"]) == ("clip 7", 3, FRAMES)
    assert manifest["garments"][0]["material"] == Material().as_dict()
    assert "material" not in manifest["garments"][1]


def test_recordings_that_cannot_be_trained_on_are_refused(tmp_path):
    """If this fails, a sequence without a body, or half a sequence, lies in the data set."""
    with pytest.raises(MeshError, match="here: no body, without which there is nothing to learn from"):
        write_as_sequence(outfit(body=None), tmp_path / "a", split="train")
    with pytest.raises(ValueError, match="split must be one of train, validation, test, got 'dev'"):
        write_as_sequence(outfit(), tmp_path / "a", split="dev")
    with pytest.raises(MeshError, match=r"collider must be bool \[4\] and keep a face"):
        write_as_sequence(outfit(), tmp_path / "a", split="train", collider=np.zeros(4, bool))
    assert not list(tmp_path.iterdir())
    write_as_sequence(outfit(), tmp_path / "a", split="train")
    with pytest.raises(FileExistsError, match="exists"):
        write_as_sequence(outfit(), tmp_path / "a", split="train")


def test_recordings_check_their_parts():
    """If this fails, a recording is built of parts that do not belong together."""
    with pytest.raises(MeshError, match="here: no garments"):
        Recording((), source="here")
    with pytest.raises(MeshError, match="garment Shirt 4, garment Jacket 4, body 4, wind 3"):
        outfit(wind=np.zeros((3, 3)))
    with pytest.raises(MeshError, match="garments run at 30 fps, the body at 24"):
        outfit(body=body_motion(fps=24.0))
    first, _ = outfit().garments
    with pytest.raises(MeshError, match="'Shirt' has 6 vertices in motion and 4 at rest"):
        Recording(((Garment(STRIP[:4], TRIANGLES[:2], name="Shirt"), first.vertices),))
    assert repr(outfit()) == "Recording('here', 4 frames at 30 fps: Shirt, Jacket on a body of 4 vertices)"


def test_resampling_goes_through_the_same_places():
    """If this fails, recordings at other rates come out faster, slower or shifted. The motion is linear in time."""
    slow = outfit(fps=15.0, body=body_motion(fps=15.0), wind=np.arange(FRAMES)[:, None] * np.ones(3))
    fast = slow.resampled(30.0)
    assert (fast.fps, len(fast), fast.body.fps) == (30.0, 7, 30.0)
    steps = moving(STRIP, 2)[1] - STRIP
    np.testing.assert_allclose(fast.garments[0].vertices, STRIP + np.arange(7)[:, None, None] / 2 * steps, atol=1e-6)
    np.testing.assert_allclose(fast.wind[:, 0], np.arange(7) / 2, atol=1e-6)
    np.testing.assert_allclose(fast.body.vertices[1] - fast.body.vertices[0], 0.005, atol=1e-6)
