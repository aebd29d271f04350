"""How much memory a simulation will take, before any of it is taken.

    memory = wg.memory.predict(garments, bodies, network.config, face_splits=2)
    print(memory)      # 1.3 GB: geodesic weights 805 MB, network 351 MB, ...

What lasts (matrices over pairs of faces or vertices above all) is counted as it is laid out; what a frame needs in
passing is the largest of its stages, by factors that were measured with torch's profiler. Predictions lie within a
factor of 1.5 of what torch allocates, from 500 faces on. The CUDA context and libraries (some 0.5 GB) come on top.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from warpgarment.errors import NotEnoughMemory
from warpgarment.geometry.pooled_geodesics import CENTRES, NEAR
from warpgarment.kernels.collision.solver import compliance
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.kernels.linear import factor
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.rows import row_groups
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies
from warpgarment.objects.sizes import Sizes

from .stages.correct import Corrector

USABLE = 0.9  # share of the free memory that a prediction may fill
PER_FACE, PER_VERTEX = 400, 800  # bytes: rest frames, indices; sparse matrices and vectors of the solvers
PER_PATCHED_FACE = 120  # bytes: the patches of a face with its shares in them, its neighbours
PER_BODY_FACE, PER_BODY_VERTEX = 400, 60  # bytes: search tree with winding numbers; positions of two frames
GRAPHED = 3  # copies of the history on a GPU: that of a state, and what a graph reads and writes
MAKING_WEIGHTS = 2.3  # matrices besides the result while geodesic weights are made
INVERTING = 3  # float64 matrices while the compliance of a component is made
STACKS = (6.0, 4.0)  # copies of the stacked features, while they are prepared and while the network runs
PATCH_STACKS = (1.0, 3.0)  # the same of a network of patches, for a single garment and for several
TOKENS = 6.5  # vectors per token within a layer, in float32; autocast keeps some more, of half the size
LANES = 16  # rows of compliance matrices are padded to a multiple of it
POISSON_FACTOR, COLLISION_FACTOR = 36.0, 85.0  # bytes for V log2 V of a component, for substitution
EXPLICIT_FACTOR = 80.0  # bytes for V^1.5, inverted
FACTOR_ENTRY = 12  # bytes
BAG_ENTRY = 12  # bytes of an entry of a sparse matrix: a column and a weight
MORE_SPLITS = (2, 4, 8, 16, 32, 64)


@dataclasses.dataclass(frozen=True)
class Memory:
    """Bytes by what they are for."""

    parts: dict[str, int]

    @property
    def total(self) -> int:
        """All of them."""
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
    correctors: Sequence[Corrector] = (),
) -> Memory:
    """What a batch takes at its peak, on its device.

    Args:
        garments: The batch; one that occurs several times shares what is constant.
        bodies: Under them, each once.
        config: Of the network.
        face_splits, half: As in `Simulator`.
        device: On a CPU, the distances that weights are made from count too.
        correctors: What changes positions after contact; each is asked for its own memory.

    Returns:
        Bytes; nothing is computed over pairs of faces, and nothing allocated.
    """
    cpu = torch.device(device).type == "cpu"
    unique = list({id(garment): garment for garment in garments}.values())
    sizes = Sizes.of(garments, bodies)
    _, vertices, faces, body_vertices, body_faces = sizes

    groups = row_groups(garments, config, face_splits)
    patches = config.architecture == "patches"
    width = config.face_embedding if patches else config.embedding
    hidden = config.face_feed_forward if patches else config.feed_forward
    weights, largest, network = 0, 0, 0
    stack = 4 * config.history * FEATURES
    stacks = STACKS
    if patches:
        stacks = (PATCH_STACKS[len(garments) > 1],) * 2
    for group in groups:
        length = max(count for _, _, count in group)
        shared = len({(id(garments[g]), first) for g, first, _ in group}) == 1
        rows = 1 if shared else len(group)
        pooled = garments[group[0][0]].pools and not patches
        if pooled and config.manifold_heads:
            each = CENTRES**2
            matrices = each * len({id(garments[g]) for g, _, _ in group})
            weights += rows * length * (2 * NEAR * BAG_ENTRY + 12) + 8 * rows * CENTRES
        else:
            each = 0 if patches or not config.manifold_heads else length**2
            matrices = rows * each
            weights += rows * length * PER_PATCHED_FACE if patches else 0
        weights += 4 * matrices
        largest = max(largest, 4 * each)
        inside = stacks[1] * stack + (2 * (TOKENS + 1.5) if half else 4 * TOKENS) * width
        inside += 4 * max(0, 2 * hidden - 3 * width)
        activations = len(group) * length * max(stacks[0] * stack, inside)
        network = max(network, int(activations) + (2 * matrices if half and not pooled else 0))

    blocks, scratch, inverted = _compliance(garments)
    passing = {
        "network": network,
        "collision forces": scratch,
        "making weights": int(MAKING_WEIGHTS * largest),
        "inverting compliance": INVERTING * 8 * inverted,
    }
    peak = max(passing, key=lambda name: passing[name])
    return Memory(
        {
            "geodesic weights": weights,
            "geodesic distances": sum(4 * _distances(g) for g in unique)
            if cpu and config.manifold_heads and not patches
            else 0,
            "compliance of collisions": blocks,
            "factors of the solvers": _factors(unique, cpu),
            "history of features": (1 if cpu else GRAPHED) * stack * faces,
            "meshes and solvers": PER_FACE * faces + PER_VERTEX * vertices,
            "bodies": PER_BODY_FACE * body_faces + PER_BODY_VERTEX * body_vertices,
            peak: passing[peak],
        }
        | {f"{c.name}, {purpose}": count for c in correctors for purpose, count in c.memory(sizes).items()}
    )


def free(device: torch.device | str) -> int | None:
    """Bytes that can still be allocated; None where that is not known (a CPU that is not Linux's)."""
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
    correctors: Sequence[Corrector] = (),
) -> None:
    """Refuses a batch that will not fit, before its memory is taken. Arguments as in `predict`.

    Raises:
        NotEnoughMemory: Names what needs how much, the limit, and what makes the batch fit.
    """
    available = free(device)
    if available is None:
        return
    limit = int(USABLE * available)

    def needs(number: int = len(garments), splits: int = face_splits, halved: bool = half) -> Memory:
        given = garments[:number]
        return predict(given, bodies, config, face_splits=splits, half=halved, device=device, correctors=correctors)

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


def _distances(garment: Garment) -> int:
    """Numbers that geodesic weights are made from: of each pair, or between the centres of pools and to them."""
    count = len(garment.faces)
    return CENTRES**2 + 2 * NEAR * count if garment.pools else count**2


def _factors(garments: Sequence[Garment], cpu: bool) -> int:
    """Bytes of the factors of the Poisson matrix and, on a CPU, of collisions that have no compliance matrix."""
    poisson = collisions = 0.0
    for garment in garments:
        for size in np.bincount(garment.components[0]):
            sparse = size * np.log2(max(size, 2))
            poisson += POISSON_FACTOR * sparse if cpu else EXPLICIT_FACTOR * size**1.5
            collisions += COLLISION_FACTOR * sparse if cpu and size > compliance.LARGEST else 0.0
    return sum(int(min(n, FACTOR_ENTRY * factor.BUDGET)) for n in (poisson, collisions))


def _compliance(garments: Sequence[Garment]) -> tuple[int, int, int]:
    """Bytes of the compliance matrices and of their scratch, and entries of the largest, as `Compliance.build`."""
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
    """The largest number up to `high` that fits, 0 if none does; whatever fits, fewer fit too."""
    low = 0
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _size(n: float) -> str:
    """Bytes as people write them."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if n >= scale:
            return f"{n / scale:.1f} {unit}"
    return f"{n / 1e3:.0f} kB"
