"""The first face that a ray meets, in both kinds of trees, against every face one by one in float64."""

import numpy as np
import pytest
import torch
import warp as wp
from support import meshes

from warpgarment.kernels import sdf
from warpgarment.kernels.sdf.first_hit import first_hit
from warpgarment.kernels.sdf.model import Bodies

BODIES = meshes.bodies()


@wp.kernel(enable_backward=False)
def hits(
    bodies: wp.array[Bodies],
    origin: wp.array[wp.vec3],
    way: wp.array[wp.vec3],
    limit: wp.array[wp.float32],
    face: wp.array[wp.int32],
    far: wp.array[wp.float32],
    turned: wp.array[wp.float32],
):
    i = wp.tid()
    f, t, s = first_hit(bodies, 0, origin[i], way[i], limit[i])
    face[i] = f
    far[i] = t
    turned[i] = s


def asked(body: meshes.Mesh, wide: bool, rays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Faces, distances and sides of the hits; outputs begin as what no hit is."""
    bodies = sdf.BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces), wide=wide)
    count = len(rays[0])
    inputs = [wp.array(a, dtype=kind) for a, kind in zip(rays, (wp.vec3, wp.vec3, wp.float32), strict=True)]
    outputs = [wp.full(count, value, dtype=kind) for value, kind in ((-99, wp.int32), *[(np.nan, wp.float32)] * 2)]
    wp.launch(hits, dim=count, inputs=[bodies.argument, *inputs], outputs=outputs)
    return tuple(output.numpy() for output in outputs)


def twin(body: meshes.Mesh, origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each ray and face [R,F]: distance, infinite where the ray misses it or passes its edges within 1e-6 of its
    size; the same with such passes; and on which side it meets the face."""
    corners = body.vertices.astype(np.float64)[body.faces]
    a, b, c = (corners[None, :, k] - origin[:, None].astype(np.float64) for k in range(3))
    along = way[:, None].astype(np.float64)
    normal = np.cross(b - a, c - a)
    facing = (normal * along).sum(2)
    volumes = np.stack([(np.cross(x, y) * along).sum(2) for x, y in ((a, b), (b, c), (c, a))])
    edge = 1e-6 * np.linalg.norm(normal, axis=2)
    with np.errstate(all="ignore"):
        far = (normal * a).sum(2) / facing
    well, nearly = (np.where((volumes * np.sign(facing) > e).all(0) & (far >= 0), far, np.inf) for e in (edge, -edge))
    return well, nearly, np.sign(facing)


def directed(way: np.ndarray) -> np.ndarray:
    """Unit vectors, float32."""
    return (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("wide", [True, False])
@pytest.mark.parametrize("name", BODIES)
def test_the_first_face_is_met(name, wide):
    """A ray that ends at a face that is further away would leave cloth inside an arm or a chest.

    Rays of any direction and length, and along axes, where boxes are flat.
    Distances within 4e-6 m, rounding of float32.
    """
    body, rng, count = BODIES[name], np.random.default_rng(0), 600
    low, high = body.vertices.min(0) - 0.2, body.vertices.max(0) + 0.2
    origin = rng.uniform(low, high, (count, 3)).astype(np.float32)
    way = directed(rng.uniform(low, high, (count, 3)) - origin)
    way[:90] = np.repeat([*np.eye(3), *-np.eye(3)], 15, axis=0)
    limit = np.where(rng.random(count) < 0.5, 1e6, rng.uniform(0.05, 0.5, count)).astype(np.float32)
    face, far, turned = asked(body, wide, [origin, way, limit])
    well, nearly, sides = twin(body, origin, way)
    sure = (well.min(1) == nearly.min(1)) & ~(np.abs(well.min(1) - limit) < 1e-5)
    met = well.min(1) < limit
    assert sure.sum() > 0.98 * count
    assert (met & sure).sum() > 40
    np.testing.assert_array_equal(face[sure], np.where(met, well.argmin(1), -1)[sure])
    met &= sure
    np.testing.assert_allclose(far[met], well.min(1)[met], atol=4e-6)
    np.testing.assert_array_equal(turned[met], sides[np.arange(count), face][met])


@pytest.mark.parametrize("name", ["tetrahedron", "icosphere"])
def test_no_ray_leaves_between_two_faces(name):
    """A ray from within that finds no way out would call a point inside an arm outside. At corners, at edges and along
    axes, against faces whose edges are passed within 1e-6 of their size; distances within 4e-6 m. In Warp's trees, 4 of
    the 900 rays find none."""
    body = meshes.tetrahedron() if name == "tetrahedron" else meshes.icosphere(3)
    rng, count = np.random.default_rng(1), 900
    shares = rng.dirichlet(np.ones(len(body.vertices[:4])), count)
    middle = body.vertices.mean(0)
    origin = (0.3 * (shares @ body.vertices[:4] - middle) + middle).astype(np.float32)
    faces = body.faces[rng.integers(0, len(body.faces), count)]
    target = body.vertices[faces[:, 0]].astype(np.float64)
    target[300:] = body.vertices[faces[300:, :2]].mean(1)
    way = directed(target - origin)
    way[600:] = np.repeat([*np.eye(3), *-np.eye(3)], 50, axis=0)
    face, far, turned = asked(body, True, [origin, way, np.full(count, 1e6, np.float32)])
    assert (face >= 0).all()
    assert (turned == 1.0).all()
    np.testing.assert_allclose(far, twin(body, origin, way)[1].min(1), atol=4e-6)
