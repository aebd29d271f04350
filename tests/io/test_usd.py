"""If these failed, another mesh, another place or another time than the stage has would be simulated."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from support.meshes import capsule, skirt

import warpgarment as wg
from warpgarment.io.usd import read_usd

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)


def new(path, rate=24.0, span=None):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    if span:
        stage.SetStartTimeCode(span[0])
        stage.SetEndTimeCode(span[1])
    return stage


def put(stage, path, frames, faces, codes=None):
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray(np.asarray(faces).reshape(-1).tolist()))
    for frame, code in zip(frames, [None] if codes is None else codes, strict=True):
        points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(frame, dtype=np.float32))
        mesh.CreatePointsAttr().Set(points, *([] if code is None else [float(code)]))
    return mesh


def at(seconds):
    """The body after some seconds [T]: a path that no line between far samples follows."""
    s = np.asarray(seconds, dtype=np.float64)[:, None, None]
    return BODY.vertices + np.concatenate([0.3 * np.sin(3 * s), 0 * s, 0.5 * s], axis=2)


@pytest.mark.parametrize(
    ("rate", "codes", "span", "fps"),
    [
        (24, np.arange(25.0), None, 24),  # frames
        (24, np.arange(1001.0, 1026), (1001, 1025), 24),
        (30, np.arange(31.0), (0, 30), 30),
        (1, np.arange(31) / 30, (0, 1), 30),  # seconds
        (1, np.arange(31) / 30, None, 30),
        (1, 5 + np.arange(26) / 25, (5, 6), 25),
        (3000, np.arange(31) * 100.0, (0, 3000), 30),  # ticks
        (4800, np.arange(121) * 40.0, None, 120),
        (6000, np.arange(61) * 100.0 + 7, (7, 6007), 60),
        (24, np.arange(0, 24.1, 0.2), (0, 24), 120),  # five samples a frame
        (60, np.arange(61.0), None, 60),
    ],
)
def test_samples_are_frames_at_the_time_they_have(tmp_path, rate, codes, span, fps):
    """Samples would be passed over, or played at another speed: positions are bit for bit those of the samples."""
    seconds = (codes - codes[0]) / rate
    stage = new(tmp_path / "m.usda", rate, span)
    put(stage, "/body", at(seconds), BODY.faces, codes)
    stage.Save()
    body = wg.BodyMotion.load(tmp_path / "m.usda")
    assert body.frames == len(codes)
    assert body.fps == pytest.approx(fps, rel=1e-6)
    np.testing.assert_array_equal(body.vertices, at(seconds).astype(np.float32))
    assert read_usd(tmp_path / "m.usda").start / body.fps == pytest.approx(codes[0] / rate, abs=1e-6)


def test_samples_that_are_missing_are_held_or_interpolated(tmp_path):
    """Writers leave out frames in which nothing moves: these would be skipped, and the motion come too early."""
    codes = np.array([0, 20, 21, 22, 26, 30.0])
    frames = np.array([0, 0, 1, 2, 6, 10])[:, None, None] * [0.01, 0, 0] + BODY.vertices
    stage = new(tmp_path / "m.usda")
    put(stage, "/body", frames, BODY.faces, codes)
    stage.Save()
    body = wg.BodyMotion.load(tmp_path / "m.usda")
    moved = body.vertices[:, 0, 0] - BODY.vertices[0, 0]
    np.testing.assert_allclose(moved, 0.01 * np.maximum(np.arange(31) - 20, 0), atol=1e-6)  # float32 of a metre
    assert body.fps == 24


def test_the_range_of_the_stage_counts(tmp_path):
    """A shot that begins before its first sample or ends before its last would be too short, or too long."""
    for span, first, last in (((-2, 4), 0, 4), ((2, 5), 2, 5), ((0, 0), 0, 8)):
        path = tmp_path / f"{first}{last}.usda"
        stage = new(path, span=span)
        put(stage, "/body", at(np.arange(9) / 24), BODY.faces, np.arange(9))
        stage.Save()
        body = wg.BodyMotion.load(path)
        assert body.frames == (span[1] - span[0] + 1 if span[1] > span[0] else 9)
        np.testing.assert_array_equal(body.vertices[[0, -1]], at(np.array([first, last]) / 24).astype(np.float32))


@pytest.mark.parametrize("end", [1e7, 1e300, float("inf")])
def test_a_range_far_beyond_the_samples_is_not_read(tmp_path, end):
    """A number in the header would ask for millions of frames."""
    stage = new(tmp_path / "m.usda", span=(0, 5))
    put(stage, "/body", at([0, 0.1]), BODY.faces, [0, 1])
    stage.SetEndTimeCode(end)
    stage.Save()
    if end == float("inf"):
        assert wg.BodyMotion.load(tmp_path / "m.usda").frames == 2
        return
    with pytest.warns(UserWarning, match="Only the time of the samples is read"):
        assert wg.BodyMotion.load(tmp_path / "m.usda").frames == 2


def test_two_samples_far_apart_are_refused(tmp_path):
    """Two samples would become a thousand million frames."""
    stage = new(tmp_path / "m.usda")
    put(stage, "/body", at([0, 0.1]), BODY.faces, [0, 1e9])
    stage.Save()
    with pytest.raises(wg.MeshError, match="2 time samples over"):
        wg.BodyMotion.load(tmp_path / "m.usda")


@pytest.mark.parametrize(("rate", "codes"), [(24, (0, 12, 24)), (1, (0, 0.5, 1)), (1000, (0, 500, 1000))])
def test_moving_transforms_are_followed(tmp_path, rate, codes):
    """A prop that its parents move would stand still, or turn along the chord: angles are those of the turn."""
    stage = new(tmp_path / "m.usda", rate)
    top = UsdGeom.Xform.Define(stage, "/top")
    slide, turn = top.AddTranslateOp(), UsdGeom.Xform.Define(stage, "/top/arm").AddRotateYOp()
    for code, angle in zip(codes, (0, 90, 180), strict=True):
        slide.Set(Gf.Vec3d(code / rate, 0, 0), code)
        turn.Set(angle, code)
    put(stage, "/top/arm/body", [BODY.vertices + np.float32([0.5, 0, 0])], BODY.faces)
    stage.Save()
    body = wg.BodyMotion.load(tmp_path / "m.usda")
    time = np.arange(body.frames) / body.fps
    assert time[-1] == pytest.approx(1)
    assert body.fps >= 24
    centre = body.vertices.mean(axis=1) - body.vertices[0].mean(axis=0) + [0.5, 0, 0]
    expected = np.stack([0.5 * np.cos(np.pi * time) + time, 0 * time, -0.5 * np.sin(np.pi * time)], axis=1)
    np.testing.assert_allclose(centre, expected, atol=1e-5)  # the capsule's centre is its axis up to float32


def character(path, frames=13, shapes=True):
    """A capsule on two joints, the upper of which bends, below a moving SkelRoot, with a blend shape for its waist."""
    stage = new(path, 24, (0, frames - 1))
    root = UsdSkel.Root.Define(stage, "/hero")
    root.AddTranslateOp().Set(Gf.Vec3d(0.2, 0, 0))
    mesh = put(stage, "/hero/body", [BODY.vertices], BODY.faces)
    skeleton = UsdSkel.Skeleton.Define(stage, "/hero/rig")
    skeleton.AddScaleOp().Set(Gf.Vec3f(1.1, 1.1, 1.1))
    skeleton.CreateJointsAttr(["hips", "hips/chest"])
    bind = [Gf.Matrix4d(1).SetTranslate((0, 0.1, 0)), Gf.Matrix4d(1).SetTranslate((0, 0.9, 0))]
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray(bind))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([bind[0], Gf.Matrix4d(1).SetTranslate((0, 0.8, 0))]))
    walk = UsdSkel.Animation.Define(stage, "/hero/walk")
    walk.CreateJointsAttr(["hips", "hips/chest"])
    walk.CreateScalesAttr([Gf.Vec3h(1)] * 2)
    for t in range(frames):
        walk.CreateTranslationsAttr().Set(Vt.Vec3fArray([(0, 0.1, 0.05 * t), (0, 0.8, 0)]), t)
        bend = Gf.Rotation((0, 0, 1), 6.0 * t).GetQuat()
        walk.CreateRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1), Gf.Quatf(bend)]), t)
    for prim in (mesh.GetPrim(), skeleton.GetPrim()):
        UsdSkel.BindingAPI.Apply(prim)
    binding = UsdSkel.BindingAPI(mesh)
    binding.CreateSkeletonRel().SetTargets(["/hero/rig"])
    UsdSkel.BindingAPI(skeleton).CreateAnimationSourceRel().SetTargets(["/hero/walk"])
    upper = np.clip((BODY.vertices[:, 1] - 0.5) / 0.8, 0, 1)
    weights = np.stack([1 - upper, upper], axis=1).astype(np.float32)
    binding.CreateJointIndicesPrimvar(False, 2).Set(Vt.IntArray([0, 1] * len(upper)))
    binding.CreateJointWeightsPrimvar(False, 2).Set(Vt.FloatArray.FromNumpy(weights.reshape(-1)))
    if shapes:
        waist = np.flatnonzero(np.abs(BODY.vertices[:, 1] - 0.9) < 0.9)
        shape = UsdSkel.BlendShape.Define(stage, "/hero/body/belly")
        shape.CreateOffsetsAttr(Vt.Vec3fArray([(0, 0, 0.1)] * len(waist)))
        shape.CreatePointIndicesAttr(Vt.IntArray(waist.tolist()))
        binding.CreateBlendShapesAttr(["belly"])
        binding.CreateBlendShapeTargetsRel().SetTargets(["/hero/body/belly"])
        walk.CreateBlendShapesAttr(["belly"])
        for t in range(frames):
            walk.CreateBlendShapeWeightsAttr().Set(Vt.FloatArray([t / frames]), t)
    stage.Save()
    return stage


@pytest.mark.parametrize("shapes", [False, True])
@pytest.mark.parametrize("instance", [False, True])
def test_a_skeleton_moves_its_mesh(tmp_path, shapes, instance):
    """A character would stand still: the oracle is UsdSkel's baker, which writes points (to 1e-5 m, float32)."""
    character(tmp_path / "hero.usda", shapes=shapes)
    path = tmp_path / "hero.usda"
    if instance:
        shot = new(tmp_path / "shot.usda", 24, (0, 12))
        prim = UsdGeom.Xform.Define(shot, "/shot").GetPrim()
        prim.GetReferences().AddReference("hero.usda", "/hero")
        shot.OverridePrim("/shot").SetTypeName("SkelRoot")
        prim.SetInstanceable(True)
        shot.Save()
        path = tmp_path / "shot.usda"
    body = wg.BodyMotion.load(path)

    stage = Usd.Stage.Open(str(tmp_path / "hero.usda"))
    assert UsdSkel.BakeSkinning(Usd.PrimRange.Stage(stage), Gf.Interval(0, 12))
    mesh = UsdGeom.Mesh.Get(stage, "/hero/body")
    expected = []
    for t in range(13):
        matrix = np.array(mesh.ComputeLocalToWorldTransform(t))
        expected.append(np.array(mesh.GetPointsAttr().Get(t)) @ matrix[:3, :3] + matrix[3, :3])
    np.testing.assert_allclose(body.vertices, expected, atol=1e-5)
    assert np.ptp(body.vertices[:, -1], axis=0).max() > 0.5, "the head hardly moves: the test shows nothing"
    assert body.fps == 24


def test_a_skeleton_that_does_not_fit_is_named(tmp_path):
    """A binding of other sizes would end in a warning on stderr and points that are not skinned."""
    stage = character(tmp_path / "hero.usda")
    UsdSkel.BindingAPI.Get(stage, "/hero/body").GetJointWeightsPrimvar().Set(Vt.FloatArray([1.0, 0.0]))
    stage.Save()
    with pytest.raises(wg.MeshError, match="'body' cannot be moved by its skeleton"):
        wg.BodyMotion.load(tmp_path / "hero.usda")


def test_instances_are_looked_into(tmp_path):
    """A shot that brings its character in as an instance would hold no mesh."""
    asset = new(tmp_path / "hero.usda", span=(0, 4))
    asset.SetDefaultPrim(UsdGeom.Xform.Define(asset, "/hero").GetPrim())
    put(asset, "/hero/body", at(np.arange(5) / 24), BODY.faces, range(5))
    asset.Save()
    shot = new(tmp_path / "shot.usda", span=(0, 4))
    for name, place in (("a", 2), ("b", 3)):
        hero = UsdGeom.Xform.Define(shot, f"/{name}")
        hero.AddTranslateOp().Set(Gf.Vec3d(place, 0, 0))
        hero.GetPrim().GetReferences().AddReference("hero.usda")
        hero.GetPrim().SetInstanceable(True)
    shot.Save()
    for name, place in (("/a/body", 2), ("/b/body", 3)):
        body = wg.BodyMotion.load(tmp_path / "shot.usda", mesh=name)
        np.testing.assert_allclose(body.vertices, at(np.arange(5) / 24) + [place, 0, 0], atol=1e-6)
    for mesh in (None, "body"):
        with pytest.raises(wg.MeshError, match=r"2 meshes.*/a/body, /b/body\. Name one"):
            wg.BodyMotion.load(tmp_path / "shot.usda", mesh=mesh)


def test_what_is_hidden_is_read_only_by_name(tmp_path):
    """A low mesh, a proxy or a guide would be simulated, or the choice called open where one mesh is shown."""
    stage = new(tmp_path / "m.usda")
    UsdGeom.Xform.Define(stage, "/hidden")
    UsdGeom.Imageable(stage.GetPrimAtPath("/hidden")).MakeInvisible()
    low = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2, around=6, rings=2)
    for path, purpose in (("/body", "render"), ("/hidden/low", None), ("/proxy", "proxy"), ("/cage", "guide")):
        shown = BODY if path == "/body" else low
        mesh = put(stage, path, [shown.vertices], shown.faces)
        if purpose:
            UsdGeom.Imageable(mesh).CreatePurposeAttr(purpose)
    stage.Save()
    assert wg.BodyMotion.load(tmp_path / "m.usda").vertices.shape[1] == len(BODY.vertices)
    for name in ("low", "/proxy", "cage"):
        assert wg.BodyMotion.load(tmp_path / "m.usda", mesh=name).vertices.shape[1] == len(low.vertices)
    with pytest.raises(wg.MeshError, match="0 meshes named 'shoe'; the stage holds /hidden/low, /body, /proxy, /cage"):
        wg.BodyMotion.load(tmp_path / "m.usda", mesh="shoe")


def test_a_stage_without_a_mesh_says_what_it_holds(tmp_path):
    """The user would be asked to name one of no meshes."""
    stage = new(tmp_path / "m.usda")
    UsdGeom.Cube.Define(stage, "/box")
    stage.Save()
    with pytest.raises(wg.MeshError, match="no mesh in this stage; it holds Cube"):
        wg.Garment.load(tmp_path / "m.usda")


@pytest.mark.parametrize("left", [False, True])
@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (1, 1, -2), (-1, -1, 1), (-1, -1, -1)])
def test_outside_stays_outside_below_a_mirror(tmp_path, left, scale):
    """Faces of a mirrored prim would look inwards: what a renderer shows has an outside that looks out."""
    mesh = skirt(12, 4)
    mirrored = np.prod(scale) < 0
    stage = new(tmp_path / "m.usda")
    UsdGeom.Xform.Define(stage, "/top").AddScaleOp().Set(Gf.Vec3f(*scale))
    faces = mesh.faces[:, ::-1] if mirrored != left else mesh.faces
    prim = put(stage, "/top/skirt", [mesh.vertices / np.float32(scale)], faces)
    if left:
        prim.CreateOrientationAttr("leftHanded")
    stage.Save()
    garment = wg.Garment.load(tmp_path / "m.usda")
    np.testing.assert_allclose(garment.vertices, mesh.vertices, atol=1e-6)
    out = garment.vertices[garment.faces].mean(axis=1) * [1, 0, 1]
    assert (np.einsum("fi,fi->f", out, garment.face_frames[..., 2]) > 0).all()


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("points", "float[]", [0.0] * 9),
        ("points", "float2[]", [(0, 0), (1, 0), (0, 1)]),
        ("points", "string[]", ["a", "b", "c"]),
        ("points", "float", 3.0),
        ("points", "string", "points"),
        ("points", "matrix4d", Gf.Matrix4d(1)),
        ("faceVertexCounts", "string[]", ["three"]),
        ("faceVertexCounts", "float[]", [3.0]),
        ("faceVertexIndices", "token[]", ["a", "b", "c"]),
        ("faceVertexIndices", "int", 3),
    ],
)
def test_attributes_of_other_types_are_named(tmp_path, name, kind, value):
    """What stands in a text file under a mesh's attributes would end in NumPy's errors."""
    layer = Sdf.Layer.CreateNew(str(tmp_path / "m.usda"))
    prim = Sdf.PrimSpec(layer, "shirt", Sdf.SpecifierDef, "Mesh")
    good = {
        "points": ("point3f[]", Vt.Vec3fArray([(0, 0, 0), (1, 0, 0), (0, 1, 0)])),
        "faceVertexCounts": ("int[]", Vt.IntArray([3])),
        "faceVertexIndices": ("int[]", Vt.IntArray([0, 1, 2])),
    }
    for key, (type_name, default) in (good | {name: (kind, value)}).items():
        Sdf.AttributeSpec(prim, key, Sdf.ValueTypeNames.Find(type_name)).default = default
    layer.Save()
    for load in (wg.Garment.load, wg.BodyMotion.load):
        with pytest.raises(wg.MeshError, match=rf"m\.usda: mesh 'shirt'.*({name}|no faces|no points)"):
            load(tmp_path / "m.usda")
