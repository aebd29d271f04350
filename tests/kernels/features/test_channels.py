"""Every row of the channel tables: features recomputed of a scene that was turned, mirrored, scaled or at rest."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support import meshes

from warpgarment.kernels import deformation, features, sdf
from warpgarment.kernels.features.channels import FACE, INTERACTION, Channel, Kind, Layout

LAYOUTS = {"face": FACE, "interaction": INTERACTION}
ROWS = [(table, channel.name) for table, layout in LAYOUTS.items() for channel in layout.channels]
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()  # about no axis in particular
REST = Rotation.from_rotvec([-0.3, 0.2, 0.9]).as_matrix()
SAME = np.eye(3)
MIRROR = np.diag([-1.0, 1.0, 1.0])
ORIGIN = np.array([0.3, -0.2, 0.1], np.float32)  # about which closest points turn
# Float32 roundings of positions around a metre, times the aspect ratio of the thinnest face, about 10
TOLERANCE = 2e-5


class Scene:
    """A skirt on a moving body after a linear map of the world, another one of the rest pose, and a change of size."""

    def __init__(self, world=SAME, rest=SAME, scale=1.0, still=False) -> None:
        garment = meshes.garments()["skirt"]
        body, after = meshes.posed_body(1.0), meshes.posed_body(1.0 if still else 4.0)
        flipped = np.linalg.det(world) < 0.0  # a mirrored face runs the other way round, so that its normal is outward

        def placed(points: np.ndarray, by: np.ndarray) -> torch.Tensor:
            return torch.from_numpy((scale * points.astype(np.float64) @ by.T).astype(np.float32))

        def wound(faces: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(faces[:, [0, 2, 1]] if flipped else faces).astype(np.int32))

        faces = wound(garment.faces)
        vertices = placed(meshes.moved(garment).vertices, world)
        inverse_rest = deformation.inverse_rest_frames(placed(garment.vertices, rest), faces)
        bodies = sdf.BodyMeshes(placed(body.vertices, world), wound(body.faces))
        centroids = deformation.face_centroids(vertices, faces)
        found = features.body_interaction(centroids, None, bodies, placed(after.vertices, world))
        one = torch.zeros(len(faces), dtype=torch.int32)
        mean = deformation.segment_mean(centroids, one, 1)
        parts = [found.closest, found.sign[:, None], found.deformation.flatten(1), found.velocity]
        self.rows = {
            "face": features.face_features(inverse_rest, vertices, faces, one, mean, found),
            "interaction": torch.cat(parts, dim=1),
        }


@pytest.fixture(scope="module")
def plain() -> Scene:
    """The scene without any change."""
    return Scene()


def tensor(matrix: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(matrix.astype(np.float32))[None]


def agree(found: torch.Tensor, expected: torch.Tensor, table: str, name: str) -> None:
    """Compares a channel; a direction is a difference of positions over its length."""
    place, tolerance = LAYOUTS[table].slices[name], torch.full((len(found), 1), TOLERANCE)
    if name == "direction_to_body":
        tolerance = TOLERANCE / expected[:, LAYOUTS[table].slices["signed_distance"]].abs().clamp(max=1.0)
    assert ((found - expected)[:, place].abs() <= tolerance).all()


def about(rows: torch.Tensor, table: str, origin: np.ndarray) -> torch.Tensor:
    """Rows whose points are relative to an origin."""
    return LAYOUTS[table].centred(rows, torch.from_numpy(origin.astype(np.float32)))


@pytest.mark.parametrize(("table", "name"), ROWS)
def test_a_turn_is_that_of_a_turned_scene(table, name, plain):
    """A network would see some channel as if only the rest of the world had turned."""
    after = about(Scene(TURN, REST).rows[table], table, TURN @ ORIGIN)
    matrix = LAYOUTS[table].turn(tensor(TURN), tensor(REST))
    agree(about(plain.rows[table], table, ORIGIN) @ matrix[0].mT, after, table, name)


@pytest.mark.parametrize(("table", "name"), ROWS)
def test_without_a_turn_of_the_rest_pose(table, name, plain):
    """The rest pose would be turned where only the world is."""
    turned = about(plain.rows[table], table, ORIGIN) @ LAYOUTS[table].turn(tensor(TURN))[0].mT
    agree(turned, about(Scene(TURN).rows[table], table, TURN @ ORIGIN), table, name)


@pytest.mark.parametrize(("table", "name"), ROWS)
def test_lengths_are_those_of_a_scaled_scene(table, name, plain):
    """A sample that is made larger would keep some distance, or stretch some direction."""
    matrix = LAYOUTS[table].turn(tensor(TURN), tensor(REST), torch.tensor([1.25]))
    after = about(Scene(TURN, REST, 1.25).rows[table], table, 1.25 * TURN @ ORIGIN)
    agree(about(plain.rows[table], table, ORIGIN) @ matrix[0].mT, after, table, name)


@pytest.mark.parametrize(("table", "name"), ROWS)
def test_a_mirror_shows_the_mirrored_scene(table, name, plain):
    """A mirrored sample would bend some other way than its mirror image."""
    mirrored = plain.rows[table] * LAYOUTS[table].mirror(torch.device("cpu"))
    agree(mirrored, Scene(MIRROR, MIRROR).rows[table], table, name)


@pytest.mark.parametrize(("table", "name"), ROWS)
def test_at_rest_the_body_does_not_move(table, name, plain):
    """A simulation would start with the body's motion of its first frame in its past."""
    before = plain.rows[table].clone()
    agree(LAYOUTS[table].still(plain.rows[table]), Scene(still=True).rows[table], table, name)
    assert torch.equal(plain.rows[table], before)  # a copy


def test_the_scenes_tell_the_rows_apart(plain):
    """Turn, mirror and rest would pass for a channel that is zero, or the same in all scenes."""
    for table, layout in LAYOUTS.items():
        turned, still = Scene(TURN, REST).rows[table], Scene(still=True).rows[table]
        for channel in layout.channels:
            place = layout.slices[channel.name]
            changed = (plain.rows[table] - turned)[:, place].abs().max() > 0.03
            assert changed == (channel.kind is not Kind.SCALAR), channel.name
            moved = (plain.rows[table] - still)[:, place].abs().max() > 1e-3
            assert moved == (channel.at_rest != "keep"), channel.name


def test_parts_of_a_table():
    """A network of some channels would be given others, or these in another order."""
    names = ("signed_distance", "normal")
    part = FACE.only(names)
    assert (part.width, part.names, part.slices) == (4, names, {"signed_distance": slice(0, 1), "normal": slice(1, 4)})
    rows = torch.arange(FACE.width) + 100.0 * torch.arange(2)[:, None]
    assert FACE.take(rows, names).tolist() == [[15.0, 9.0, 10.0, 11.0], [115.0, 109.0, 110.0, 111.0]]
    assert FACE.take(rows, FACE.names) is rows
    with pytest.raises(ValueError, match="no feature channel 'colour'; there are deformation_gradient, normal, "):
        FACE.only(("colour",))
    with pytest.raises(ValueError, match="more than once"):
        FACE.only(("normal", "normal"))


def test_a_row_must_hold_what_its_kind_says():
    """A vector of four numbers would be turned by leaving one out."""
    with pytest.raises(ValueError, match="channel heat is a VECTOR of width 4, not 3"):
        Layout((Channel("heat", 4, Kind.VECTOR),))
