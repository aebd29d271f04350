"""Predicts the memory of a simulation before any of it is allocated.

    memory = wg.memory.predict(garments, bodies, network.config, face_splits=2)
    print(memory)      # 1.3 GB: geodesic weights 805 MB, network 351 MB, ...

Lasting memory (above all matrices over pairs of faces or vertices) is counted from the sizes of its arrays. Temporary
memory is that of the largest stage of a frame, by factors measured with torch's profiler. The memory of the network is
predicted by its kind (`Architecture.memory`). From 500 faces on, predictions lie within a factor of 1.5 of what torch
allocates. The CUDA context and libraries take some 0.5 GB more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from warpgarment.errors import NotEnoughMemory
from warpgarment.kernels.collision import compliance, compliance_rows
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.kernels.linear import factor
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import NetworkSizes
from warpgarment.nn.rows import first_equal
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies
from warpgarment.objects.sizes import Sizes
from warpgarment.sim.stages import relax
from warpgarment.sim.stages.correct import Corrector

from .history import copies

USABLE = 0.9  # share of the free memory that a prediction may fill
PER_FACE, PER_VERTEX = 550, 1100  # bytes of rest frames and indices; of sparse matrices and vectors of the solvers
PER_BODY_FACE, PER_BODY_VERTEX = (240, 140), 60  # bytes of a tree, Warp's on a GPU and ours on a CPU; of two positions
GRAPHED = 3  # copies of the history on a GPU: of a state, and the input and output of a graph
INVERTING = 3, 1  # number of float64 matrices while the compliance of a component is made, on a GPU and on a CPU
LANES = 16  # rows of compliance matrices are padded to a multiple of this
POISSON_FACTOR, COLLISION_FACTOR = 36.0, 85.0  # bytes of a factor for substitution, per V log2 V of a component
EXPLICIT_FACTOR = 80.0  # bytes of an inverted factor, per V^1.5 of a component
FACTOR_ENTRY = 12  # bytes of an entry of a factor
TOUCHED = 0.5  # share of the vertices of a large component that are in contact at some time, and have a row then
IN_CONTACT = 0.6  # share of the vertices that are in contact at a time; what scratch has for others is not resident
MORE_SPLITS = (2, 4, 8, 16, 32, 64)


@dataclasses.dataclass(frozen=True)
class Memory:
    """Bytes by purpose."""

    parts: dict[str, int]

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return sum(self.parts.values())

    def __str__(self) -> str:
        largest = sorted(self.parts.items(), key=lambda part: -part[1])
        return f"{_size(self.total)}: " + ", ".join(f"{name} {_size(n)}" for name, n in largest if n)


def predict(
    garments: Sequence[Garment],
    bodies: PackedBodies | Sequence[BodyMotion],
    config: NetworkConfig,
    *,
    face_splits: int = 1,
    half: bool = False,
    device: torch.device | str = "cpu",
    physics: int | None = None,
    correctors: Sequence[Corrector] = (),
    layers: Sequence[Sequence[int]] = (),
) -> Memory:
    """Predicts the peak memory of a batch on its device.

    Args:
        garments: The batch; garments of one mesh share their constants.
        bodies: The bodies of the batch, each once.
        config: Settings of the network.
        face_splits: Number of subsets of faces, as in `Simulator.rollout`.
        half: Whether the network runs in bfloat16, as in `Simulator`.
        device: Device of the simulation; on a CPU, the distances from which weights are made count too.
        physics: Iterations of the cloth's own physics in a frame; None: as the configuration says.
        correctors: Correctors of the simulation, each of which predicts its own memory.
        layers: Garments of each outfit, as numbers in the batch.

    Returns:
        Bytes by purpose. The prediction itself allocates no arrays over pairs of faces.
    """
    cpu = torch.device(device).type == "cpu"
    relaxes = bool(config.physics if physics is None else physics)
    garments = [garments[first] for first in first_equal(garments)]  # those of one mesh share their constants
    unique = list({id(garment): garment for garment in garments}.values())
    sizes = Sizes.of(garments, bodies)
    _, vertices, faces, body_vertices, body_faces = sizes

    shown = NetworkSizes(garments, face_splits, half, cpu, body_vertices)
    network = dict(architecture(config.architecture).memory(shown, config))
    blocks, scratch, inverted = _compliance(garments)
    kind = architecture(config.architecture)
    histories = copies(faces, config.history, separate=not kind.positions, apart=kind.apart) if cpu else GRAPHED
    history = int(histories * 4 * config.history * FEATURES * faces)
    later = history + network.get("packed weights", 0)  # what is not there yet while a scene is made
    passing = {
        "network": network.pop("network", 0),
        "collision forces": int(IN_CONTACT**2 * scratch) if cpu else scratch,
        "making weights": max(0, network.pop("making weights", 0) - later),
        "inverting compliance": max(0, INVERTING[cpu] * 8 * inverted - later),
    }
    peak = max(passing, key=lambda name: passing[name])
    return Memory(
        {
            **network,
            "compliance of collisions": blocks,
            "rows of compliance": _rows(unique) if cpu else 0,
            "factors of the solvers": _factors(unique, cpu),
            "history of features": history,
            "meshes and solvers": PER_FACE * faces + PER_VERTEX * vertices,
            "physics": (relax.PER_VERTEX * vertices + relax.PER_FACE * faces + _factors(unique, cpu)) * relaxes,
            "pairs of layers": _pairs([len(garments[i].faces) for outfit in layers for i in outfit]),
            "bodies": PER_BODY_FACE[cpu] * body_faces + PER_BODY_VERTEX * body_vertices,
            peak: passing[peak],
        }
        | {f"{c.name}, {purpose}": count for c in correctors for purpose, count in c.memory(sizes).items()}
    )


def free(device: torch.device | str) -> int | None:
    """Bytes that can still be allocated; None if that is not known, as on a CPU without /proc/meminfo."""
    device = torch.device(device)
    if device.type == "cuda":
        unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)  # kept by torch for reuse
        return torch.cuda.mem_get_info(device)[0] + unused
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None


def check(
    garments: Sequence[Garment],
    bodies: PackedBodies | Sequence[BodyMotion],
    config: NetworkConfig,
    *,
    face_splits: int = 1,
    half: bool = False,
    device: torch.device | str = "cpu",
    physics: int | None = None,
    correctors: Sequence[Corrector] = (),
    layers: Sequence[Sequence[int]] = (),
) -> None:
    """Checks that a batch fits on its device, before memory is allocated. The arguments are those of `predict`.

    Raises:
        NotEnoughMemory: It does not fit; the message names the parts, the limit, and settings with which it would fit.
    """
    available = free(device)
    if available is None:
        return
    limit = int(USABLE * available)

    def needs(number: int = len(garments), splits: int = face_splits, halved: bool = half) -> Memory:
        given = garments[:number]
        return predict(
            given,
            bodies,
            config,
            face_splits=splits,
            half=halved,
            device=device,
            physics=physics,
            correctors=correctors,
            layers=[[i for i in outfit if i < number] for outfit in layers],
        )

    needed = needs()
    if needed.total <= limit:
        return
    ways = []
    if not half and needs(halved=True).total <= limit:
        ways.append("half=True")
    splits = next((n for n in MORE_SPLITS if n > face_splits and needs(splits=n).total <= limit), None)
    if splits:
        ways.append(f"face_splits={splits}")
    most = _largest(len(garments) - 1, lambda number: needs(number).total <= limit)
    if most:
        ways.append(f"at most {most:,} of the {len(garments):,} garments at a time")
    remedy = f"It fits with {' or with '.join(ways)}." if ways else "Coarsen the garments, or take a larger device."
    raise NotEnoughMemory(
        f"{len(garments):,} garments need {needed}. That is more than {_size(limit)}, {USABLE:.0%} of what is free on "
        f"{device}. {remedy}"
    )


def _pairs(faces: Sequence[int]) -> int:
    """Bytes of pairs of faces and their directions, and of boxes and a tree, of outfits with garments of that many."""
    if not faces:
        return 0
    from warpgarment.kernels.cloth.pairs import PARTNERS  # loads kernels that only outfits launch

    return (PARTNERS * (4 + 3 * 12) + 200) * sum(faces)


def _factors(garments: Sequence[Garment], cpu: bool) -> int:
    """Bytes of the factors of the Poisson matrix and, on a CPU, of collisions that have no compliance matrix."""
    poisson = collisions = 0.0
    for garment in garments:
        for size in np.bincount(garment.components[0]):
            sparse = size * np.log2(max(size, 2))
            poisson += POISSON_FACTOR * sparse if cpu else EXPLICIT_FACTOR * size**1.5
            collisions += COLLISION_FACTOR * sparse if cpu and size > compliance.LARGEST else 0.0
    return sum(int(min(n, FACTOR_ENTRY * factor.BUDGET)) for n in (poisson, collisions))


def _rows(garments: Sequence[Garment]) -> int:
    """Bytes of rows of compliance matrices of components that have no such matrix, as in `compliance_rows`."""
    sizes = np.concatenate([np.bincount(garment.components[0]) for garment in garments])
    sizes = sizes[sizes > compliance.LARGEST]
    pitch = -(-sizes // LANES) * LANES
    room = compliance_rows.BUDGET // max(1, len(sizes)) // np.maximum(pitch, 1)
    return int(4 * (pitch * np.minimum(np.ceil(TOUCHED * sizes), room)).sum())


def _compliance(garments: Sequence[Garment]) -> tuple[int, int, int]:
    """Bytes of the compliance matrices and of their scratch, and entries of the largest, as in `Compliance.build`."""
    used = needed = largest = 0
    known = set()
    for garment in garments:
        of_vertex = garment.components[0]
        for component, size in enumerate(np.bincount(of_vertex)):
            entries = int(size) * (-(-int(size) // LANES) * LANES)
            if size > compliance.LARGEST or needed + entries > compliance.BUDGET:
                continue
            needed, largest = needed + entries, max(largest, entries)
            if (id(garment), component) not in known:
                known.add((id(garment), component))
                used += entries
    return 4 * used, 4 * needed, largest


def _largest(high: int, fits: Callable[[int], bool]) -> int:
    """The largest number up to `high` that fits, 0 if none does. If a number fits, all smaller ones must fit too."""
    low = 0
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _size(n: float) -> str:
    """A number of bytes with its unit, as text."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if n >= scale:
            return f"{n / scale:.1f} {unit}"
    return f"{n / 1e3:.0f} kB"
