"""Pictures: the depth buffer against brute-force rays, colours against the sRGB formula, files whole or absent."""

from __future__ import annotations

import sys

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import warp as wp
from support import meshes

from warpgarment.errors import MissingExtra, UsageError
from warpgarment.kernels.render import raster, shading
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view import draw

SIZE = 48


def _view(*, perspective: bool) -> raster.View:
    view = raster.View()
    view.eye, view.forward = (0.1, 0.2, 3.0), (0.0, 0.0, -1.0)
    view.right, view.up = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    view.width = view.height = SIZE
    view.scale, view.perspective = (90.0, True) if perspective else (30.0, False)
    return view


def _nearest_faces(vertices: np.ndarray, faces: np.ndarray, view: raster.View) -> tuple[np.ndarray, ...]:
    """Moeller-Trumbore in float64, all rays against all faces: face (-1: none), depth, distance to the nearest edge."""
    x, y = np.meshgrid(np.arange(SIZE) + 0.5 - SIZE / 2, SIZE / 2 - np.arange(SIZE) - 0.5)
    flat = np.stack([x.ravel(), y.ravel()], axis=1) / view.scale
    eye = np.array([view.eye[k] for k in range(3)])
    if view.perspective:
        origin = np.broadcast_to(eye, (SIZE * SIZE, 3))
        direction = np.column_stack([flat, -np.ones(len(flat))])
    else:
        origin = eye + np.column_stack([flat, np.zeros(len(flat))])
        direction = np.broadcast_to([0.0, 0.0, -1.0], (SIZE * SIZE, 3))
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(direction[:, None], e2[None])
    det = np.einsum("rfk,fk->rf", p, e1)
    t = origin[:, None] - a[None]
    q = np.cross(t, e1[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("rfk,rfk->rf", t, p) / det
        v = np.einsum("rk,rfk->rf", direction, q) / det
        depth = np.einsum("fk,rfk->rf", e2, q) / det
        margin = np.minimum(np.minimum(u, v), 1 - u - v)  # negative outside
    depth = np.where((margin >= 0) & (depth > 0), depth, np.inf)
    face = np.where(np.isfinite(depth).any(1), depth.argmin(1), -1)
    return face, depth.min(1), np.abs(np.nan_to_num(margin, nan=1.0)).min(1)


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("name", ["sphere", "two spheres", "random triangles"])
def test_depth_buffer_keeps_the_nearest_triangle(name: str, perspective: bool) -> None:
    """Wrong faces in front, holes or a wrong depth: the picture would show what lies behind.

    Reference: every ray against every face in float64. Pixels whose ray passes within 1e-3 (barycentric) of an edge are
    left out, since float32 may decide either way there; depth to 1e-5 relative, float32 with a few roundings.
    """
    if name == "sphere":
        mesh = meshes.icosphere(1)
    elif name == "two spheres":
        mesh = meshes.joined(meshes.icosphere(1), meshes.icosphere(1, centre=(0.2, 0.1, 0.4)))
    else:
        rng = np.random.default_rng(3)
        mesh = meshes.Mesh(rng.normal(0, 0.4, (60, 3)).astype(np.float32), np.arange(60, dtype=np.int32).reshape(20, 3))
    view = _view(perspective=perspective)
    vertices = wp.array(mesh.vertices, dtype=wp.vec3, device="cpu")
    _, buffer = raster.rasterise(view, vertices, wp.array(mesh.faces, dtype=wp.int32, device="cpu"))
    words = buffer.numpy().ravel()
    face, depth, margin = _nearest_faces(mesh.vertices, mesh.faces, view)
    sure = margin > 1e-3
    assert sure.mean() > 0.8
    np.testing.assert_array_equal((words & 0xFFFFFFFF)[sure] - 1, face[sure])
    hit = sure & (face >= 0)
    assert hit.sum() > 100
    closeness = (words >> 32).astype(np.int32).view(np.float32)[hit]
    expected = 1 / depth[hit] if perspective else 100.0 - depth[hit]
    np.testing.assert_allclose(closeness, expected, rtol=1e-5)


def test_resolve_is_a_box_filter_and_srgb() -> None:
    """Wrong brightness in every picture. Reference: the sRGB formula in NumPy; one level for rounding."""
    light = np.random.default_rng(0).uniform(-0.1, 1.2, (8, 12, 3)).astype(np.float32)
    light[:2, :2] = 0.001  # the linear foot of the curve
    pixels = wp.full((4, 6, 3), 77, dtype=wp.uint8, device="cpu")
    image = wp.array(light, dtype=wp.vec3, device="cpu")
    wp.launch(shading.resolve_kernel, dim=(4, 6), inputs=[image, 2], outputs=[pixels], device="cpu")
    mean = light.astype(np.float64).reshape(4, 2, 6, 2, 3).mean((1, 3)).clip(0, 1)
    expected = 255 * np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * mean ** (1 / 2.4) - 0.055)
    assert np.abs(pixels.numpy() - expected).max() <= 1.0


def test_linear_inverts_srgb() -> None:
    """Colours other than those asked for. 0.5 in sRGB is 0.2140 in linear light (IEC 61966-2-1), to 4 digits."""
    np.testing.assert_allclose(draw.linear((0.5, 0.0, 1.0)), [0.2140, 0.0, 1.0], atol=5e-5)
    np.testing.assert_allclose(draw.linear("#ff0080"), [1.0, 0.0, 0.2159], atol=5e-5)


def test_framing_sees_every_vertex() -> None:
    """A head cut off. All vertices, projected in NumPy, are inside the picture, and fill at least half of it."""
    points = np.random.default_rng(1).normal(size=(200, 3)) * [0.3, 0.9, 0.2] + [5, 1, -2]
    for size in ((640, 640), (240, 340), (640, 200)):
        camera = draw.Camera.framing(points, size=size, azimuth=40)
        right, up, forward = camera.axes()
        d = points - (np.asarray(camera.target) + camera.distance * camera.direction)
        scale = 0.5 * size[1] / np.tan(np.radians(camera.field_of_view) / 2)
        x, y = scale * (d @ right) / (d @ forward), scale * (d @ up) / (d @ forward)
        assert (np.abs(x) <= size[0] / 2).all()
        assert (np.abs(y) <= size[1] / 2).all()
        assert max(np.abs(x).max() / size[0], np.abs(y).max() / size[1]) > 0.4


def test_ball_casts_a_shadow_on_the_floor() -> None:
    """No shadow, or one on the wrong side: the key light is over the viewer's left shoulder, so it falls to the right.

    Compared: the same floor without a shadow caster. The ball floats, so the shadow is not hidden behind it.
    """
    ball = meshes.icosphere(2, radius=0.15, centre=(0.0, 0.3, 0.0))
    camera = draw.Camera((0.0, 0.1, 0.0), 4.0, azimuth=0.0, elevation=35.0)
    speck = draw.Surface(np.float32([[0, 0.2, 0], [1e-3, 0.2, 0], [0, 0.201, 0]]), np.int32([[0, 1, 2]]))
    corners = draw.Surface(ball.vertices, ball.faces[:0])
    picture = draw.render([draw.Surface(ball.vertices, ball.faces, "#ffffff")], camera, size=(120, 120), floor=0.0)
    empty = draw.render([speck, corners], camera, size=(120, 120), floor=0.0)
    darker = empty.astype(int).sum(2) - picture.astype(int).sum(2) > 60
    assert darker[:, 70:].sum() > 50
    assert darker[:, :45].sum() == 0


def test_vertices_that_are_not_finite_leave_the_rest_of_the_picture() -> None:
    """One NaN blanks the picture of a rollout that failed, just when it is wanted.

    The vertex nearest to the camera leaves a hole in the middle of the ball, not wider than 20 of 64 pixels; elsewhere
    the picture stays as it was, to 2 levels.
    """
    ball = meshes.icosphere(2)
    camera = draw.Camera((0, 0, 0), 4.0)
    whole = draw.render([draw.Surface(ball.vertices, ball.faces)], camera, size=(64, 64))
    vertices = ball.vertices.copy()
    vertices[(vertices @ camera.direction).argmax()] = np.nan
    broken = draw.render([draw.Surface(vertices, ball.faces, lining=True)], camera, size=(64, 64))
    changed = np.abs(broken.astype(int) - whole).max(2) > 2
    rows, columns = np.nonzero(changed)
    assert changed.sum() > 20
    assert np.ptp(rows) < 20
    assert np.ptp(columns) < 20
    with pytest.raises(ValueError, match="no surface"):
        draw.render([])


def _moving_balls() -> tuple[BodyMotion, GarmentMotion]:
    ball = meshes.icosphere(1)
    steps = np.arange(5, dtype=np.float32)[:, None, None] * np.float32([0.05, 0, 0])
    body = BodyMotion(ball.vertices + steps, ball.faces, 30.0)
    return body, GarmentMotion(1.1 * ball.vertices + steps, ball.faces[:40], 30.0, name="cap")


def test_contact_sheet_has_a_row_for_each_motion(tmp_path) -> None:
    """Rows or moments missing. 3 moments of 64 pixels; two rows, each 80 pixels below a title of 30."""
    body, cap = _moving_balls()
    picture = draw.contact_sheet(tmp_path / "sheet.png", body, [cap], [cap], frames=3, size=(64, 80))
    assert picture.shape == (2 * (80 + 30), 3 * 64, 3)
    np.testing.assert_array_equal(iio.imread(tmp_path / "sheet.png"), picture)
    panels = picture[30:110, :, :].reshape(80, 3, 64, 3).astype(int)
    assert np.abs(panels[:60, 0] - panels[:60, 2]).mean() < 3  # the camera follows, so moments look alike
    coral = (picture[..., 0].astype(int) - picture[..., 2]) > 60
    assert coral[:110].sum() > 200
    assert coral[110:].sum() == 0  # the ground truth is drawn in another colour


def test_motions_of_other_rates_are_drawn_at_one_moment(tmp_path) -> None:
    """A body of another rate or start would be drawn elsewhere than its garment. The pictures of the same motion at the
    garment's rate, exactly where frames coincide; captions say the time."""
    body, cap = _moving_balls()
    fine = body.resampled(60.0)
    slow = BodyMotion(body.vertices[::2], body.faces, 15.0)
    early = BodyMotion(np.concatenate([body.vertices[:1] - 1] * 3 + [body.vertices]), body.faces, 30.0, start=-0.1)
    expected = list(draw.film(body, [cap], size=(64, 80)))
    sheet = draw.contact_sheet(tmp_path / "a.png", body, [cap], frames=3, size=(64, 80))
    for other in (fine, slow, early):
        pictures = list(draw.film(other, [cap], size=(64, 80)))
        assert len(pictures) == 5
        np.testing.assert_array_equal(pictures, expected)
        np.testing.assert_array_equal(
            draw.contact_sheet(tmp_path / "b.png", other, [cap], frames=3, size=(64, 80)), sheet
        )
    far = BodyMotion(body.vertices, body.faces, 30.0, start=100.0)
    with pytest.raises(UsageError, match=r"no frame in common: the body has 5 frames, 3000 to 3004 .*; cap has 5"):
        next(draw.film(far, [cap]))


def test_film_is_read_back_with_all_frames(tmp_path) -> None:
    """A film that players refuse, or that lost frames. Counted by ffmpeg, compared to 8 levels (it is compressed)."""
    body, cap = _moving_balls()
    pictures = list(draw.film(body, [cap], size=(63, 80)))
    assert draw.write_mp4(tmp_path / "film.mp4", pictures, 25.0) == 5
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == 5
    assert seconds == pytest.approx(0.2, abs=0.05)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    width, height = next(reader)["size"]
    assert (width, height) == (62, 80)
    first = np.frombuffer(next(reader), np.uint8).reshape(height, width, 3)
    reader.close()
    assert np.abs(first.astype(int) - pictures[0][:, :62]).mean() < 8


def test_a_film_that_fails_leaves_no_file(tmp_path) -> None:
    """Half a film under the name of a whole one."""

    def failing():
        yield np.zeros((32, 32, 3), np.uint8)
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        draw.write_mp4(tmp_path / "film.mp4", failing())
    with pytest.raises(ValueError, match="no frame"):
        draw.write_mp4(tmp_path / "empty.mp4", [])
    assert list(tmp_path.iterdir()) == []


def test_palette_keeps_the_picture_and_saves_half(tmp_path):
    """Pictures of tables would fill the repository, or come out spotted. A shaded ball: no channel off by 8 of 255."""
    y, x = np.mgrid[-1:1:200j, -1:1:200j]
    light = np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))
    image = (
        np.stack([60 + 150 * light, 90 + 120 * light, 200 - 90 * light], -1) + 2 * np.sin(40 * x)[..., None]
    ).astype(np.uint8)
    draw.write_png(tmp_path / "all.png", image)
    draw.write_png(tmp_path / "few.png", image, colors=256)
    few = iio.imread(tmp_path / "few.png", mode="RGB").astype(int)
    assert np.abs(few - image).max() < 8
    assert (tmp_path / "few.png").stat().st_size < (tmp_path / "all.png").stat().st_size / 2


@pytest.mark.parametrize(("module", "call"), [("imageio.v3", "write_png"), ("imageio_ffmpeg", "write_mp4")])
def test_missing_extra_is_named(monkeypatch, tmp_path, module: str, call: str) -> None:
    """A ModuleNotFoundError from deep inside instead of what to install."""
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=r"warpgarment\[view\]"):
        getattr(draw, call)(tmp_path / "x", np.zeros((1, 8, 8, 3), np.uint8))
