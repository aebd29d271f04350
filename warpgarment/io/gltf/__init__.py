"""glTF 2.0 (.glb, .gltf): meshes moved by their nodes, by morph targets and by skins, at the times of the keyframes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import Format, Holds, MeshData, MotionData, ReadOptions
from warpgarment.io.joined import join_exact
from warpgarment.io.parts import ALL, Parts, connected_pieces, listed, named, unconnected
from warpgarment.io.surface.record import say_left_out, worth_keeping
from warpgarment.io.times import frames_of

from .animation import Channels
from .container import Document
from .looks import SETS, surface_of
from .scene import Placed, Scene
from .schema import Damaged
from .writing import write_gltf

LARGEST, RATIO = 256 << 20, 1_000  # bytes of positions from which on a file must have a thousandth of them


def read_gltf(path: Path, *, mesh: str | None = None, moving: bool = True) -> tuple[MotionData, str]:
    """Meshes of the scene as one, in metres and Y up as glTF has them, vertices at the same place joined.

    Args:
        path: The file.
        mesh: Name of a node or of a mesh; "*" reads all as one.
        moving: All frames of the first animation; otherwise the pose that the nodes have without one.

    Raises:
        MeshError: Not a glTF file, cut short, one that needs a compression, or with indices or sizes that do not fit;
            no such mesh; or several that are not connected, and none was named.

    Warns:
        UserWarning: There are several animations.
    """
    try:
        document = Document(path)
        channels = Channels(document if moving else _still(document), path)
        frames = frames_of(channels.times(), 1.0, None, turns=True, where=str(path))
        codes = frames.codes if len(frames.codes) else np.zeros(1)
        scene = Scene(document, channels, codes)
        size = 12 * len(codes) * sum(map(scene.size, scene.meshes))
        if size > max(LARGEST, RATIO * document.size):
            raise MeshError(
                f"{path}: {len(codes):,} frames of {len(scene.meshes):,} meshes would take {size:,} bytes, of a file "
                f"of {document.size:,}. More than {LARGEST:,} are read only of files with a thousandth of that."
            )
        placed = [scene.placed(number) for number in scene.meshes]
    except Damaged as error:
        raise MeshError(
            f"{path}: not a readable glTF file ({str(error)[:200]}). It is damaged, cut short, or of another kind."
        ) from None
    placed = [one for one in placed if len(one.faces)]
    if not placed:
        raise MeshError(f"{path}: no triangles in it; it is damaged, cut short, or a point cloud.")
    names = Parts([one.name for one in placed], np.arange(len(placed)))
    if mesh not in (None, ALL):
        chosen = named(path, str(mesh), names, Parts([one.mesh for one in placed], np.arange(len(placed))))
        placed = [one for one, wanted in zip(placed, chosen, strict=True) if wanted]
    vertices, faces, owner, split = _joined(placed)
    if mesh is None:
        pieces = connected_pieces(vertices.shape[1], np.full(len(faces), 3), faces.reshape(-1))
        if unconnected(Parts(names.names, owner), pieces):
            raise MeshError(
                f"{path}: {len(placed)} meshes: {listed(names.used())}. Name one with mesh=, or read them as one with "
                f'mesh="{ALL}".'
            )
    name = placed[0].name if len(placed) == 1 else ""
    seconds = float(codes[0]) if len(frames.codes) else None
    surface = worth_keeping(path, lambda: surface_of(path, document, placed, split, faces))
    return MotionData(vertices, faces, frames.fps, name=name, seconds=seconds, surface=surface), name


def _still(document: Document) -> Document:
    document.json.pop("animations", None)
    return document


def _joined(placed: list[Placed]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Meshes as one: positions float32 [T,V,3], faces [F,3], the mesh of each face [F], and faces before the joining.

    Vertices become one where they are at exactly the same place in the first, the middle and the last frame.
    """
    count = max(len(one.vertices) for one in placed)
    together = [np.broadcast_to(one.vertices, (count, *one.vertices.shape[1:])) for one in placed]
    with np.errstate(over="ignore"):
        vertices = np.concatenate(together, axis=1).astype(np.float32)
    bases = np.cumsum([0, *(one.vertices.shape[1] for one in placed)])
    faces = np.concatenate([one.faces + base for one, base in zip(placed, bases[:-1], strict=True)])
    owner = np.repeat(np.arange(len(placed)), [len(one.faces) for one in placed])
    places = vertices[[0, count // 2, count - 1]].transpose(1, 0, 2).reshape(vertices.shape[1], -1)
    kept, joined = join_exact(places, faces)
    return vertices[:, kept], joined, owner, faces


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    found, name = read_gltf(path, mesh=options.mesh, moving=False)
    return MeshData(found.vertices[0], found.faces, name=name, surface=found.surface)


def _write_mesh(path: Path, data: MeshData) -> None:
    _write_motion(path, MotionData(np.asarray(data.vertices)[None], data.faces, name=data.name, surface=data.surface))


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    return read_gltf(path, mesh=options.mesh)[0]


def _holds(path: Path) -> Holds:
    try:
        document = Document(path)
        return Holds(
            tuple(dict.fromkeys(Scene(document, Channels(_still(document), path), np.zeros(1)).names())), 1.0, "y"
        )
    except Damaged:
        return Holds((), 1.0, "y")


def _write_motion(path: Path, data: MotionData) -> None:
    say_left_out(path, data.surface, sets=SETS, keeps="materials")
    write_gltf(path, data)


FORMAT = Format(None, _read_mesh, _write_mesh, _read_motion, _write_motion, named=True, axis=True, holds=_holds)
