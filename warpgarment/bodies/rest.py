"""A body at rest: its surface, the bones inside it, and how the surface follows them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.npz import read_npz

PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")
_BUNDLED = Path(__file__).parent.parent / "assets" / "demo" / "rest_body.npz"
_SAVED = {  # of a body in a file: kinds of numbers, and the shape, where a letter is the same size throughout
    "vertices": ("f", "V3"), "faces": ("iu", "F3"), "joints": ("f", "B3"), "bone_names": ("U", "B"),
    "bone_parents": ("iu", "B"), "bone_indices": ("iu", "VK"), "bone_weights": ("f", "VK"), "phenotype": ("f", "P"),
}  # fmt: skip


@dataclass(frozen=True)
class RestBody:
    """A body shape in its rest pose (arms lowered by about 45 degrees), with its bones and skinning weights.

    Attributes:
        vertices: Rest vertices [m], shape [U, 3].
        faces: Vertex indices, counter-clockwise seen from outside, shape [G, 3].
        joints: Rest position of each bone's head [m], shape [B, 3].
        bone_names: CMU MotionBuilder names of the bones, length B.
        bone_parents: Parent of each bone, -1 for the root, length B; parents come first.
        bone_indices: Bones that move each vertex, shape [U, K].
        bone_weights: Weight of each of these bones, every row summing to 1, shape [U, K].
        phenotype: Anny's values from which the body was made; empty for bodies that are not Anny's.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    bone_names: tuple[str, ...]
    bone_parents: tuple[int, ...]
    bone_indices: np.ndarray
    bone_weights: np.ndarray
    phenotype: dict[str, float]

    def save(self, path: str | Path) -> None:
        """Writes the body as .npz."""
        np.savez_compressed(
            path,
            vertices=self.vertices.astype(np.float32),
            faces=self.faces,
            joints=self.joints.astype(np.float32),
            bone_names=np.array(self.bone_names),
            bone_parents=np.array(self.bone_parents, dtype=np.int32),
            bone_indices=self.bone_indices,
            bone_weights=self.bone_weights,
            phenotype=np.array([self.phenotype.get(name, np.nan) for name in PHENOTYPES]),
        )

    @classmethod
    def load(cls, path: str | Path) -> RestBody:
        """Reads a body from the .npz file that :meth:`save` wrote.

        Raises:
            MeshError: An array is missing, of another type or shape, not finite, or names bones or vertices that there
                are not.
        """
        data = read_npz(Path(path), tuple(_SAVED), _SAVED.__contains__)
        _check_saved(path, data)
        phenotype = zip(PHENOTYPES, data["phenotype"].tolist(), strict=True)
        return cls(
            vertices=data["vertices"].astype(np.float64),
            faces=data["faces"],
            joints=data["joints"].astype(np.float64),
            bone_names=tuple(str(n) for n in data["bone_names"]),
            bone_parents=tuple(int(p) for p in data["bone_parents"]),
            bone_indices=data["bone_indices"],
            bone_weights=data["bone_weights"],
            phenotype={name: value for name, value in phenotype if np.isfinite(value)},
        )

    def bone(self, name: str) -> int:
        """Index of a bone by its name."""
        return self.bone_names.index(name)

    def joint(self, name: str) -> np.ndarray:
        """Rest position of a bone's head [m], shape [3]."""
        return self.joints[self.bone(name)]

    def chain(self, root: str) -> list[int]:
        """Indices of a bone and of all bones below it."""
        bones = [self.bone(root)]
        for bone in range(bones[0] + 1, len(self.bone_names)):
            if self.bone_parents[bone] in bones:
                bones.append(bone)
        return bones

    def weight_of(self, *roots: str) -> np.ndarray:
        """Share (0 to 1) of each vertex that moves with the chains below the given bones, shape [U]."""
        dense = np.zeros((len(self.vertices), len(self.bone_names)))
        np.add.at(dense, (np.arange(len(self.vertices))[:, None], self.bone_indices), self.bone_weights)
        return dense[:, sorted({b for root in roots for b in self.chain(root)})].sum(1)

    def collider_faces(self) -> np.ndarray:
        """Mask of the faces with which cloth collides, bool [G]: all but hands and forearms, which would pinch it."""
        forearm = self.weight_of("LeftForeArm", "RightForeArm")
        return (forearm < 0.5)[self.faces].all(1)


@lru_cache(maxsize=1)
def bundled_body() -> RestBody:
    """The body that is part of the package; it needs neither a download nor an extra."""
    return RestBody.load(_BUNDLED)


def _check_saved(path: str | Path, data: dict[str, np.ndarray]) -> None:
    """Raises MeshError unless the arrays of a saved body have their types and shapes, and indices are in range."""
    sizes: dict[str, int] = {}
    for name, (kinds, shape) in _SAVED.items():
        array = data[name]
        fits = array.dtype.kind in kinds and array.ndim == len(shape) and array.size > 0
        if not fits or any(sizes.setdefault(s, n) != n for s, n in zip(shape, array.shape, strict=True)):
            raise MeshError(f"{path}: {name} is {array.dtype} {list(array.shape)}, which does not fit a body.")
    bounds = (("faces", "V", 0), ("bone_indices", "B", 0), ("bone_parents", "B", -1))
    wrong = [name for name, size, low in bounds if ((data[name] < low) | (data[name] >= sizes[size])).any()]
    wrong += [name for name in ("vertices", "joints", "bone_weights") if not np.isfinite(data[name]).all()]
    if wrong or sizes["3"] != 3 or len(data["phenotype"]) != len(PHENOTYPES):
        raise MeshError(f"{path}: {(wrong or ['phenotype'])[0]} holds numbers that no body has. It is damaged.")
