"""How Warp's kernels are compiled on a CPU: what shortens the first rollout on a machine.

Warp compiles a module of kernels whole, when one of them is first launched: `apart` gives those a module of their own
that a rollout does not launch. Each thread that compiles first reads Warp's headers, once for each set of flags, so
all modules have the same. `ahead` compiles on all cores what would be compiled one by one.

A kernel that asks for its row with `i = wp.tid()` is compiled twice for a CPU, for arrays without gaps and for any;
`i, _ = wp.tid()` is compiled once. The row is the same on all devices: the second dimension of a launch of one is one.
Kernels of a rollout are written so where it saves the compiler's time, and none of them runs slower.

With `max_unroll=1` loops are left to the compiler, which unrolls them too; Warp would write out each pass before. Such
modules have no adjoints: Warp's adjoint of a loop is right only where the loop was written out, or overwrites nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import warp as wp

from .started import start

_WARPS_OWN = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4"
)
"""Warp's own flags; with thresholds forty times the compiler's, kernels compile a third longer and run no faster."""
_FLAGS = "-march=native -DWP_NO_BFLOAT16 -fpch-instantiate-templates -disable-llvm-verifier -discard-value-names"
"""No operators for `wp.bfloat16`, which no kernel here uses; templates are made once, with the headers. The compiler
neither names its values nor checks its own passes, as in releases of Clang, whose driver Warp does without."""


def options(**more: Any) -> dict[str, Any]:
    """Options of a module of kernels, for `wp.set_module_options`.

    Args:
        more: Further options of the module.

    Returns:
        The options, with flags for the CPU's compiler where the user has left those of Warp as they are.
    """
    return {"cpu_compiler_flags": _FLAGS if wp.config.cpu_compiler_flags == _WARPS_OWN else None, **more}


def apart(name: str, **more: Any) -> wp.Module:
    """The module of kernels that are not to be compiled with the others of their file: `@wp.kernel(module=apart(...))`.

    Args:
        name: Name of the module.
        more: Options of the module, as of `options`.
    """
    module = wp.get_module(name)
    wp.set_module_options(options(**more), module)
    return module


OF_A_FRAME = (
    "sdf.searches",
    "collision.forces_inverse_cpu",
    "collision.body_contacts",
    "sdf.surface_depth",
    "sdf.tree",
    "mesh.windows",
    "deformation.replaced_eight",
    "deformation.next_frame",
    "linear.triangular",
    "poisson.kernels",
    "deformation.face_means",
    "sdf.inside",
    "deformation.gradients.rest",
    "features.carry",
    "collision.contact_set",
    "linear.progress",
    "replay.team",
)
"""Modules of `warpgarment.kernels` that a rollout of a garment launches, whatever the network; slow ones first."""
MOST_WORKERS = 4
"""Modules that are compiled at a time, each of which takes some 100 MB; as in Warp."""


def ahead(names: Iterable[str]) -> int:
    """Compiles modules for the CPU that are not in Warp's cache, several at a time, where there are several cores.

    Which cores there are is a matter of the system, as for any compiler; it does not depend on `OMP_NUM_THREADS`.

    Args:
        names: Names of modules below `warpgarment.kernels`. Those that were not imported have no kernels yet, and are
            left out.

    Returns:
        The number of modules that were compiled.
    """
    start()
    modules = [wp.get_module(f"warpgarment.kernels.{name}") for name in names]
    missing = [module for module in modules if module.kernels and not _is_cached(module)]
    workers = min(len(missing), _cores(), MOST_WORKERS)
    if workers < 2:
        return 0
    wp.force_load("cpu", missing, max_workers=workers)
    return len(missing)


def _is_cached(module: wp.Module) -> bool:
    """Whether Warp has compiled a module, as it is now, before; a CPU's blocks have one thread."""
    folder = Path(wp.config.kernel_cache_dir or "", module.get_module_identifier(1))
    return any(folder.glob("*.o"))


def _cores() -> int:
    """Number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
