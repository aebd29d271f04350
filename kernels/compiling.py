"""How Warp's kernels are compiled on a CPU: what shortens the first rollout on a machine.

Warp compiles a module of kernels whole, when one of them is first launched: `apart` gives those a module of their own
that a rollout does not launch. Each process that compiles first reads Warp's headers, once for each set of flags, so
all modules have the same.
"""

from __future__ import annotations

from typing import Any

import warp as wp

_WARPS_OWN = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4"
)
"""Warp's own flags; with thresholds forty times the compiler's, kernels compile a third longer and run no faster."""
_FLAGS = "-march=native -DWP_NO_BFLOAT16 -fpch-instantiate-templates"
"""No operators for `wp.bfloat16`, which no kernel here uses; templates are made once, with the headers."""


def options(**more: Any) -> dict[str, Any]:
    """Options of a module of kernels, for `wp.set_module_options`.

    Args:
        more: Further options of the module.

    Returns:
        The options, with flags for the CPU's compiler where the user has left those of Warp as they are.
    """
    return {"cpu_compiler_flags": _FLAGS if wp.config.cpu_compiler_flags == _WARPS_OWN else None, **more}


def apart(name: str) -> wp.Module:
    """The module of kernels that are not to be compiled with the others of their file: `@wp.kernel(module=apart(...))`.

    Args:
        name: Name of the module.
    """
    module = wp.get_module(name)
    wp.set_module_options(options(), module)
    return module
