"""Nothing of a body comes through edges and faces whose corners are all outside."""

import igl
import numpy as np
import pytest
import torch
import trimesh
from support import meshes
from support.poison import poison_outputs
from support.scenes import network

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import surface_depth
from warpgarment.kernels.sdf.vertex_depth import Measured
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.stages import contact
from warpgarment.sim.stages.reconstruct import Reconstruct
from warpgarment.sim.surface import AMPLE, distance_to_keep

LATTICE = np.array([(a, b, 10 - a - b) for a in range(11) for b in range(11 - a)]) / 10.0
BALL = meshes.icosphere(3, radius=0.25)


def below_ball(points):
    """Depth in `BALL` by libigl, in float64; 0 outside."""
    return np.maximum(-igl.signed_distance(np.atleast_2d(points), BALL.vertices.astype(float), BALL.faces)[0], 0.0)


def found_by(mesh, owner, body, limit=0.0, wide=None):
    """`surface_depth` in `BALL`, in NumPy; outputs are poisoned by the caller."""
    bodies = BodyMeshes(torch.from_numpy(BALL.vertices), torch.from_numpy(BALL.faces), wide=wide)
    integers = (np.asarray(a, np.int32) for a in (body, edges_of(mesh.faces), mesh.faces, owner))
    body, edges, faces, owner = map(torch.from_numpy, integers)
    at, count = torch.from_numpy(mesh.vertices), int(owner.max()) + 1
    result = surface_depth(at, bodies, body, edges, faces, owner, count, limit=limit)
    return [tensor.numpy() for tensor in result[:2]]


def edges_of(faces):
    """Every edge once, lower index first."""
    return np.array(sorted({tuple(sorted((f[k], f[(k + 1) % 3]))) for f in faces.tolist() for k in range(3)}))


def below_tip(corners):
    """The point of a face nearest to the vertex of `BALL` that stands out of it most, below 1 cm: [1,3] or [0,3]."""
    tips = BALL.vertices.astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    same = trimesh.Trimesh(tips, BALL.faces, process=False).face_normals @ normal > 0
    feet = trimesh.triangles.closest_point(np.repeat(corners[None], len(tips), 0), tips)
    away = np.linalg.norm(tips - feet, axis=1)
    fits = ((tips - corners[0]) @ normal > 0) & (away < 0.01) & np.isin(np.arange(len(tips)), BALL.faces[same])
    return feet[[np.where(fits, away, 0).argmax()]] if fits.any() else np.empty((0, 3))


def twin(mesh, owner, body):
    """The same point by point, in float64, and before it the depth of each vertex."""
    x = mesh.vertices.astype(np.float64)
    depth, missing, deepest = np.where(body == 0, below_ball(x), 0.0), np.zeros(len(x)), np.zeros(owner.max() + 1)
    np.maximum.at(deepest, owner, depth)
    for corners in [*edges_of(mesh.faces).tolist(), *mesh.faces.tolist()]:
        if body[corners[0]] == 0:
            points = x[corners].mean(axis=0, keepdims=True)
            if len(corners) == 3:
                points = np.concatenate([points, below_tip(x[corners])])
            worst = below_ball(points).max()
            deepest[owner[corners[0]]] = max(deepest[owner[corners[0]]], worst)
            missing[corners] = np.maximum(missing[corners], worst - depth[corners].max())
    return depth, deepest, missing


@pytest.mark.parametrize("wide", [True, False])
@pytest.mark.parametrize("limit", [0.0, 0.012, 0.1])
@pytest.mark.parametrize("shift", [0.0, 0.02])
def test_depths_are_those_of_a_twin(monkeypatch, shift, limit, wide):
    """A point left out lets the body through; one of a garment that is on no body is moved for nothing.

    With limits, points near vertices that are far enough outside are left out, and nothing may change; nor with the
    trees of a CPU in place of Warp's, which a GPU searches.

    Three balls of cloth around a body of 25 cm, of which the second is on no body. Vertices are 10 mm outside or,
    shifted, up to 10 mm inside at one end. 1e-6 m: float32 positions of the points.
    """
    ball = meshes.icosphere(1, radius=0.26, centre=(shift, 0, 0))
    mesh, size = meshes.joined(ball, ball, ball), len(ball.vertices)
    mesh.vertices[:] += np.random.default_rng(0).normal(0, 1e-3, mesh.vertices.shape).astype(np.float32)
    owner = np.repeat([0, 1, 2], size)
    body = np.where(owner == 1, -1, 0)
    poison_outputs(monkeypatch)
    deepest, missing = found_by(mesh, owner, body, limit, wide)
    depth, *expected = twin(mesh, owner, body)
    np.testing.assert_allclose(deepest, expected[0], atol=1e-6)
    np.testing.assert_allclose(missing, expected[1], atol=1e-6)
    assert deepest[1] == 0
    assert min(deepest[0], deepest[2]) > 0.004
    assert (depth.max() > 0.005) == (shift > 0)
    assert 10 < np.count_nonzero(missing) <= 2 * size


@pytest.mark.parametrize("wide", [True, False])
def test_what_was_measured_before_changes_nothing(wide, monkeypatch):
    """A vertex that went in since the last pass, or came out, would be taken for what it was. Exact, over five moves.

    A ball of cloth of 2,000 faces, 20 mm outside at one side and 3 mm inside at the other; moves from 1e-5 to 10 mm.
    """
    mesh, random = meshes.icosphere(3, radius=0.258, centre=(0.011, 0, 0)), np.random.default_rng(0)
    bodies = BodyMeshes(torch.from_numpy(BALL.vertices), torch.from_numpy(BALL.faces), wide=wide)
    edges, faces = (torch.from_numpy(np.asarray(a, np.int32)) for a in (edges_of(mesh.faces), mesh.faces))
    none, before, at = torch.zeros(len(mesh.vertices), dtype=torch.int32), None, torch.from_numpy(mesh.vertices)
    poison_outputs(monkeypatch)
    spared = 0
    for move in (0.0, 1e-5, 1e-3, 1e-2, 2e-4, 0.0):
        at = at + torch.from_numpy(random.normal(0.0, move, at.shape).astype(np.float32))
        fresh = surface_depth(at, bodies, none, edges, faces, none, 1, limit=0.02)
        found = surface_depth(at, bodies, none, edges, faces, none, 1, limit=0.02, before=before)
        assert torch.equal(found.garments, fresh.garments)
        assert torch.equal(found.missing, fresh.missing)
        assert torch.equal(found.depth, fresh.depth)
        assert (found.clear <= fresh.clear + 1e-7).all()
        spared += int((found.clear < fresh.clear - 1e-6).sum())
        before = Measured(at, found.depth, found.clear)
        queried = [bodies.query(at, within=0.01, clear=clear) for clear in (None, found.clear)]
        for mine, theirs in zip(*queried, strict=True):
            assert torch.equal(torch.nan_to_num(mine, nan=-9.0), torch.nan_to_num(theirs, nan=-9.0))
    assert spared > 100  # it was used
    assert fresh.garments[0] > 0.002


def test_tips_are_found_between_the_points():
    """A body vertex would come through where no middle is. A spike of 6 mm, at a tenth of a face or beside it."""
    cloth = meshes.Mesh(np.float32([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]]), np.int32([[0, 1, 2]]))
    for off, depth in ((0.03, True), (-0.02, False)):
        corners = np.float32([[0, 0, 0], [-1, -1, -2], [1, -1, -2], [1, 1, -2], [-1, 1, -2]])
        faces = np.int32([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]])
        spike = meshes.Mesh(0.01 * corners + np.float32([off, 0.03, 0.006]), faces)
        bodies = BodyMeshes(torch.from_numpy(spike.vertices), torch.from_numpy(spike.faces))
        none, one = torch.zeros(3, dtype=torch.int32), torch.from_numpy(cloth.faces)
        edges = torch.from_numpy(edges_of(cloth.faces).astype(np.int32))
        found = surface_depth(torch.from_numpy(cloth.vertices), bodies, none, edges, one, none, 1)
        assert (found.garments[0] > 0.001) == depth
        assert (found.missing > 0).all() == depth


def test_positions_that_are_not_finite_are_outside(monkeypatch):
    """One diverged garment would make the others of a batch count as deep without end."""
    mesh = meshes.icosphere(1, radius=0.26)
    mesh.vertices[0] = np.nan
    poison_outputs(monkeypatch)
    count = len(mesh.vertices)
    deepest, missing = found_by(mesh, np.zeros(count, int), np.zeros(count, int))
    assert missing[0] == 0
    assert np.isfinite(missing).all()
    assert 0 < deepest[0] < 0.02


def test_corners_keep_what_is_missing_between_them():
    """Corners that are far would stay where they are; those that keep enough already would be drawn in."""
    x = np.float32([[0.26, 0, 0], [0, 0.27, 0], [0, 0, 0.28], [0.3, 0, 0]])
    bodies = BodyMeshes(torch.from_numpy(BALL.vertices), torch.from_numpy(BALL.faces))
    epsilon, missing = torch.tensor([0.004, 0.004, 0.04, 0.004]), torch.tensor([0.002, 0.002, 0.002, 0.0])
    found = distance_to_keep(epsilon, missing, torch.from_numpy(x), bodies, torch.zeros(4, dtype=torch.int32))
    np.testing.assert_allclose(found, [0.01 + AMPLE * 0.002, 0.02 + AMPLE * 0.002, 0.04, 0.004], atol=1e-6)


@pytest.mark.parametrize("looks_between", [True, False])
def test_a_knob_does_not_show_through(monkeypatch, looks_between):
    """Cloth of 8 cm triangles that would stay where it is, and a ball of 3 cm that comes up between its vertices.

    Depth by libigl at 66 points a face. 0.1 mm is where passes end; where edges cross more may be left,
    here 0.2 mm.
    """
    solve = Reconstruct.__call__
    monkeypatch.setattr(
        Reconstruct, "__call__", lambda self, vertices, *rest: (vertices, solve(self, vertices, *rest)[1])
    )
    if not looks_between:
        monkeypatch.setattr(contact, "distance_to_keep", lambda epsilon, *_: epsilon)
    x, z = (axis.ravel() for axis in np.meshgrid(*[0.08 * np.arange(-2, 3)] * 2, indexing="ij"))
    corner = np.arange(20).reshape(4, 5)[:, :4].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 6], 1), np.stack([corner, corner + 6, corner + 5], 1)]
    )
    cloth = Garment(np.stack([x, 0 * x, z], 1), faces)
    ball = meshes.icosphere(3, radius=0.03, centre=(0.04, -0.036, 0.03))
    rise = 0.01 * np.arange(3)[:, None, None] * np.float32([0.0, 1.0, 0.0])
    body = BodyMotion(ball.vertices + rise, ball.faces, 30.0)
    result = Simulator(network(), "cpu", epsilon=0.004).rollout(cloth, body)
    inner = np.einsum("kc,fcd->fkd", LATTICE, result.vertices[-1][cloth.faces].astype(float)).reshape(-1, 3)
    deepest = -igl.signed_distance(inner, body.vertices[-1].astype(float), body.faces)[0].min()
    assert deepest < 2e-4 if looks_between else deepest > 2e-3
    said = result.status[-1].max_penetration
    assert said < 1e-4 if looks_between else 2e-3 < said <= deepest + 1e-6
