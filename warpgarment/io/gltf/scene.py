"""Meshes of a glTF scene over time: below moving nodes, morphed, and skinned by joints."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from warpgarment.progress import parts

from .animation import Channels, local_matrices
from .container import Document
from .schema import Damaged

TRIANGLES, STRIP, FAN = 4, 5, 6


class Part(NamedTuple):
    """A primitive of a mesh, and how many vertices and triangles it has."""

    primitive: dict[str, Any]
    vertices: int
    faces: int


class Placed(NamedTuple):
    """One mesh: name of its node, else its own; its own; positions [T,V,3]; faces [F,3]; its primitives in order."""

    name: str
    mesh: str
    vertices: np.ndarray
    faces: np.ndarray
    parts: tuple[Part, ...] = ()


class Scene:
    """The nodes of a document's scene.

    Args:
        document: The file.
        channels: Its animation.
        times: When positions are wanted [s], shape [T].
    """

    def __init__(self, document: Document, channels: Channels, times: np.ndarray):
        self._document, self._channels, self._times = document, channels, times
        self._parents: dict[int, int] = {}
        nodes = document.json.get("nodes", [])
        for number in range(len(nodes)):
            for child in document.item("nodes", number).get("children", []):
                document.item("nodes", child)
                if child in self._parents:
                    raise Damaged(f"node {child} has two parents")
                self._parents[child] = number
        scenes = document.json.get("scenes")
        roots = set(document.item("scenes", document.json.get("scene", 0)).get("nodes", [])) if scenes else None
        self._world: dict[int, np.ndarray] = {}
        self.meshes = []
        for number, node in enumerate(nodes):
            if "mesh" in node and (roots is None or self._chain(number)[-1] in roots):
                self.meshes.append(number)

    def names(self) -> list[str]:
        """What the meshes of the scene are called, in the order of `meshes`."""
        return [self._name(number) for number in self.meshes]

    def _name(self, number: int) -> str:
        """The name of a node, else of its mesh, else its number."""
        node = self._document.item("nodes", number)
        name = node.get("name") or self._document.item("meshes", node["mesh"]).get("name")
        return str(name or f"node {number}")

    def _chain(self, number: int) -> list[int]:
        """A node, its parent, and so on."""
        chain = [number]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
            if len(chain) > len(self._document.json["nodes"]):
                raise Damaged(f"node {number} is its own ancestor")
        return chain

    def _matrices(self, number: int) -> np.ndarray:
        """Transforms of a node in the world [T,4,4], or [1,4,4] where it does not move."""
        for at in reversed(self._chain(number)):
            if at not in self._world:
                local = local_matrices(self._document.item("nodes", at), at, self._channels, self._times)
                parent = self._parents.get(at)
                self._world[at] = local if parent is None else self._world[parent] @ local
        return self._world[number]

    def size(self, number: int) -> int:
        """Vertices of the mesh of a node."""
        mesh = self._document.item("meshes", self._document.item("nodes", number)["mesh"])
        return sum(len(self._document.array(_accessor(p["attributes"], "POSITION"))) for p in mesh["primitives"])

    def placed(self, number: int) -> Placed:
        """The mesh of a node, all its primitives."""
        node = self._document.item("nodes", number)
        mesh = self._document.item("meshes", node["mesh"])
        vertices, faces, parts, base = [], [], [], 0
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", TRIANGLES)
            if mode not in (TRIANGLES, STRIP, FAN):
                continue  # points and lines
            positions = self._positions(node, number, mesh, primitive)
            corners = self._faces(primitive, mode, positions.shape[1])
            mirrored = np.linalg.det(self._matrices(number)[0, :3, :3]) < 0 and "skin" not in node
            faces.append((corners[:, ::-1] if mirrored else corners) + base)
            vertices.append(positions)
            parts.append(Part(primitive, positions.shape[1], len(corners)))
            base += positions.shape[1]
        count = max((len(v) for v in vertices), default=1)
        together = [np.broadcast_to(v, (count, *v.shape[1:])) for v in vertices]
        name = str(mesh.get("name", ""))
        return Placed(
            self._name(number),
            name,
            np.concatenate(together, axis=1) if together else np.zeros((1, 0, 3)),
            np.concatenate(faces) if faces else np.zeros((0, 3), dtype=np.int64),
            tuple(parts),
        )

    def _positions(
        self, node: dict[str, Any], number: int, mesh: dict[str, Any], primitive: dict[str, Any]
    ) -> np.ndarray:
        """Positions in the world, [T,V,3], or [1,V,3] where nothing moves."""
        attributes = primitive["attributes"]
        points = _points(self._document.array(_accessor(attributes, "POSITION")))[None]
        targets = [t["POSITION"] for t in primitive.get("targets", []) if "POSITION" in t]
        if targets:
            every = [k for k, t in enumerate(primitive["targets"]) if "POSITION" in t]
            weights = self._channels.values(number, "weights", self._times)
            if weights is None:
                still = node.get("weights", mesh.get("weights", [0.0] * len(primitive["targets"])))
                weights = np.array(still, dtype=np.float64)[None]
            if weights.shape[1] != len(primitive["targets"]):
                raise Damaged(f"{weights.shape[1]} weights for {len(primitive['targets'])} morph targets")
            points = np.repeat(points, len(weights), axis=0)
            for k, target in zip(every, targets, strict=True):
                move, there = _points(self._document.array(target), points.shape[1]), weights[:, k] != 0
                points[there] += weights[there, k, None, None] * move
        if "skin" in node:
            return self._skinned(points, self._document.item("skins", node["skin"]), attributes)
        matrices = self._matrices(number)
        return points @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3]

    def _skinned(self, points: np.ndarray, skin: dict[str, Any], attributes: dict[str, Any]) -> np.ndarray:
        """Positions that joints move; glTF leaves the transform of the mesh's own node out."""
        count, joints = points.shape[1], skin["joints"]
        bind = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            bind = self._document.array(skin["inverseBindMatrices"]).astype(np.float64)
            if bind.ndim != 2 or bind.shape[1] != 16 or len(bind) < len(joints):
                raise Damaged(f"matrices of shape {list(bind.shape)} for {len(joints)} joints")
            bind = bind.reshape(-1, 4, 4).transpose(0, 2, 1)[: len(joints)]
        world = [self._matrices(self._checked(joint)) @ matrix for joint, matrix in zip(joints, bind, strict=True)]
        sets = [k for k in range(8) if f"JOINTS_{k}" in attributes]
        each_index = [self._document.array(attributes[f"JOINTS_{k}"]) for k in sets]
        each_weight = [self._document.array(_accessor(attributes, f"WEIGHTS_{k}")) for k in sets]
        if not sets or not joints or any(a.shape != (count, 4) for a in (*each_index, *each_weight)):
            raise Damaged("joints and weights of a skin do not fit its mesh")
        index, weight = np.concatenate(each_index, axis=1), np.concatenate(each_weight, axis=1).astype(float)
        if index.dtype.kind != "u" or (count and index.max() >= len(joints)):
            raise Damaged("joints of a skin that there are not")
        index = index.astype(int)
        total = weight.sum(axis=1, keepdims=True)
        weight = np.where(total > 0, weight / np.where(total > 0, total, 1.0), 0.0)
        rows = np.repeat(np.arange(count), index.shape[1])
        blend = csr_matrix((weight.reshape(-1), (rows, index.reshape(-1))), shape=(count, len(joints)))
        frames = max(len(points), *(len(m) for m in world))
        moved = np.empty((frames, count, 3))
        for t in parts(range(frames), "reading"):
            transforms = np.stack([m[min(t, len(m) - 1)] for m in world])[:, :3].reshape(len(joints), 12)
            each = (blend @ transforms).reshape(count, 3, 4)
            moved[t] = np.einsum("vij,vj->vi", each[:, :, :3], points[min(t, len(points) - 1)]) + each[:, :, 3]
        return moved

    def _checked(self, joint: Any) -> int:
        self._document.item("nodes", joint)
        return int(joint)

    def _faces(self, primitive: dict[str, Any], mode: int, count: int) -> np.ndarray:
        if "indices" in primitive:
            corners = self._document.array(primitive["indices"])
            if corners.ndim != 1 or corners.dtype.kind != "u":
                raise Damaged("indices that are no whole numbers")
            corners = corners.astype(np.int64)
        else:
            corners = np.arange(count)
        if len(corners) and corners.max() >= count:
            raise Damaged(f"a face names vertex {int(corners.max()):,}, and there are {count:,}")
        if mode == TRIANGLES:
            if len(corners) % 3:
                raise Damaged(f"{len(corners):,} corners are no triangles")
            return corners.reshape(-1, 3)
        k = np.arange(max(len(corners) - 2, 0))
        if mode == FAN:
            return np.stack([corners[k + 1], corners[k + 2], corners[0 * k]], axis=1)
        return np.stack([corners[k], corners[k + 1 + k % 2], corners[k + 2 - k % 2]], axis=1)


def _accessor(attributes: dict[str, Any], name: str) -> int:
    """The accessor of an attribute that must be there."""
    if name not in attributes:
        raise Damaged(f"a primitive without {name}")
    return attributes[name]


def _points(array: np.ndarray, count: int | None = None) -> np.ndarray:
    if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
        raise Damaged(f"positions of shape {list(array.shape)}")
    return array.astype(np.float64)
