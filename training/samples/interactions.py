"""The body near each face of a garment, computed once per sequence and kept beside the data.

Closest points and signs depend on the recorded garment, not on the network, and slightly displaced garments may reuse
them (`kernels.features.face_features` recomputes the distance from the closest point). So the signed-distance queries,
the most expensive part of a training sample, run once for every frame t in 0..T-2. Their results are memory-mapped
arrays

    interaction.npy   float32 [T-1, F, 16]   columns of `kernels.features.channels.INTERACTION`; row t is the body at t
                                             and its motion from t to t + 1
    geodesics.npy     float32 [F, F]         metres, inf across components; absent beyond 10,000 faces

in a folder named after the sequence and the checksum of everything they depend on (array files, versions). A folder is
written under a temporary name and renamed when complete. Its manifest holds the checksums of its files, and a folder
that does not match them is computed again.

    python -m warpgarment.training.samples.interactions DATA [CACHE]        # fills the cache before a training run
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import zlib
from pathlib import Path

import numpy as np
import torch

import warpgarment
from warpgarment.io.disk.atomic import atomic_folder
from warpgarment.io.disk.plain import JSON_LARGEST, open_plain, read_plain
from warpgarment.kernels.deformation.gradients import face_centroids
from warpgarment.kernels.features.channels import INTERACTION
from warpgarment.kernels.features.face import BodyInteraction, body_interaction
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.training.rollouts import RecordedOnBody

CACHE_VERSION = 3  # 1: over edges and vertices of the body, any of the nearest faces; 2: closest points 0.1 mm off
MANIFEST = "manifest.json"
_SOURCES = (
    "garment_rest_vertices", "garment_faces", "garment_vertices", "body_rest_vertices", "body_faces", "collider_faces",
    "bone_indices", "bone_weights", "bone_transforms",
)  # fmt: skip
_SOURCES_2 = (
    "garment_positions", "garment_boxes", "body_rest_positions", "body_rest_box", "bone_rotations", "bone_translations",
    "bone_origins", "body_positions", "body_boxes",
)  # fmt: skip


class UnusableSequence(ValueError):
    """A sequence that cannot be trained on; the message says why."""


def default_cache(data: Path) -> Path:
    """The cache folder beside a data folder: `sequences` -> `sequences.cache`."""
    data = Path(data).resolve()
    return data.parent / f"{data.name}.cache"


def key_of(folder: Path) -> str:
    """Checksum of the arrays and versions that the cached values depend on."""
    digest = hashlib.sha256(f"{CACHE_VERSION} {warpgarment.__version__}".encode())
    for name in _SOURCES:
        path = Path(folder) / f"{name}.npy"
        digest.update(name.encode())
        digest.update(path.read_bytes() if path.exists() else b"-")
    for name in _SOURCES_2:  # without these arrays, the key is that of format 1
        path = Path(folder) / f"{name}.npy"
        if path.exists():
            digest.update(name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def compute(sequence: RecordedOnBody, device: torch.device | str = "cpu") -> np.ndarray:
    """Computes the interaction of every face with the body in every frame but the last.

    Args:
        sequence: A `data.sequence.Sequence`, or an object with `garment`, `vertices` and `body()`.
        device: Device on which the queries run.

    Returns:
        Interactions, float32 [T-1, F, 16], columns as in `INTERACTION`.
    """
    device = torch.device(device)
    faces = torch.as_tensor(np.ascontiguousarray(sequence.garment.faces), dtype=torch.int32, device=device)
    body = sequence.body()
    body_vertices = torch.as_tensor(np.asarray(body.vertices, np.float32), device=device)
    body_faces = torch.as_tensor(np.asarray(body.faces, np.int32), device=device)
    frames = min(len(sequence.vertices), len(body_vertices))
    out = np.empty((frames - 1, len(faces), INTERACTION.width), np.float32)
    meshes = BodyMeshes(body_vertices[0].contiguous(), body_faces)
    for t in range(frames - 1):
        if t:
            meshes.update(body_vertices[t].contiguous())
        vertices = torch.as_tensor(np.array(sequence.vertices[t], np.float32), device=device)
        found = body_interaction(face_centroids(vertices, faces), None, meshes, body_vertices[t + 1].contiguous())
        out[t] = pack(found).cpu().numpy()
    return out


def pack(found: BodyInteraction) -> torch.Tensor:
    """Packs a BodyInteraction of F faces as an array [F, 16], without the index of the body face."""
    return torch.cat(
        [found.closest, found.sign[:, None].to(torch.float32), found.deformation.reshape(-1, 9), found.velocity], dim=1
    )


def unpack(rows: torch.Tensor) -> BodyInteraction:
    """Unpacks [N, 16] as a BodyInteraction with body face -1, which the feature kernel does not need."""
    none = torch.full((len(rows),), -1, dtype=torch.int32, device=rows.device)
    closest, sign, deformation, velocity = (rows[:, place] for place in INTERACTION.slices.values())
    return BodyInteraction(
        closest=closest.contiguous(),
        sign=sign.flatten().contiguous(),
        face=none,
        deformation=deformation.reshape(-1, 3, 3).contiguous(),
        velocity=velocity.contiguous(),
    )


def cached(
    sequence: RecordedOnBody, folder: Path, cache: Path, device: torch.device | str = "cpu"
) -> tuple[np.ndarray, np.ndarray | None]:
    """Loads interactions and geodesics of a sequence from the cache; missing ones are computed and stored first.

    Args:
        sequence: The loaded sequence.
        folder: Folder of the sequence.
        cache: Root folder of the cache; it is made if missing.
        device: Device on which missing values are computed.

    Returns:
        Memory maps of interactions, float32 [T-1, F, 16], and of geodesic distances [m], float32 [F, F]. The latter are
        None for garments with pooled distances.

    Raises:
        UnusableSequence: The values are not finite.
    """
    cache = Path(cache)
    place = cache / f"{Path(folder).name}-{key_of(folder)}"
    names = ["interaction.npy"] if sequence.garment.pools else ["interaction.npy", "geodesics.npy"]
    if not _whole(place, names):
        shutil.rmtree(place, ignore_errors=True)  # so that the new folder can take its place
        interaction = compute(sequence, device)
        if not np.isfinite(interaction).all():
            raise UnusableSequence("body interaction is not finite (degenerate body faces or NaN in the body motion)")
        with atomic_folder(place, "*", stays=lambda found: _whole(found, names)) as temporary:
            np.save(temporary / "interaction.npy", interaction)
            if not sequence.garment.pools:
                np.save(temporary / "geodesics.npy", np.asarray(sequence.garment.geodesics, np.float32))
            (temporary / MANIFEST).write_text(_manifest(temporary), "utf-8")
    interaction = np.load(place / "interaction.npy", mmap_mode="r")
    if sequence.garment.pools:
        return interaction, None
    return interaction, np.load(place / "geodesics.npy", mmap_mode="r")


def _manifest(place: Path) -> str:
    """Text of the manifest of a complete folder: the CRC-32 of each array file, header included."""
    sums = {}
    for path in sorted(place.glob("*.npy")):
        value = 0
        with open_plain(path) as file:
            while block := file.read(2**20):
                value = zlib.crc32(block, value)
        sums[path.name] = f"{value:08x}"
    return json.dumps({"cache_version": CACHE_VERSION, "crc32": sums})


def _whole(place: Path, names: list[str]) -> bool:
    """Whether a folder has these files, and all its files have the checksums of its manifest."""
    try:
        manifest = read_plain(place / MANIFEST, JSON_LARGEST).decode("utf-8")
        return all((place / name).exists() for name in names) and manifest == _manifest(place)
    except (OSError, ValueError):
        return False


def main(arguments: list[str]) -> None:
    """Fills the cache of a data folder; prints the name of each sequence, and the reason if it cannot be used."""
    from warpgarment.training.data.sequence import Sequence, list_sequences

    data = Path(arguments[0])
    cache = Path(arguments[1]) if len(arguments) > 1 else default_cache(data)
    for folder in list_sequences(data):
        try:
            cached(Sequence.load(folder), folder, cache)
        except (ValueError, OSError) as error:
            print(f"skipped {folder.name}: {error}")
            continue
        print(folder.name)


if __name__ == "__main__":
    main(sys.argv[1:])
