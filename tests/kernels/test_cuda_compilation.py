"""Every kernel must compile for a GPU, on machines that have none: NVRTC, which Warp ships, needs no device."""

import importlib
import pkgutil
from pathlib import Path

import pytest
import warp as wp

import warpgarment.kernels

ARCHITECTURE = 90  # an H100

NAMES = [m.name for m in pkgutil.walk_packages(warpgarment.kernels.__path__, "warpgarment.kernels.")]
NAMES += ["warpgarment.training.teachers.newton.kernels"]


def warp_modules(name: str) -> dict[str, wp.Module]:
    """The Warp modules of a Python module: the one named like it, and those of its kernels declared with
    module="unique"."""
    python_module = importlib.import_module(name)
    kernels = [k for k in vars(python_module).values() if isinstance(k, wp.Kernel)]
    return {k.module.name: k.module for k in kernels if k.func.__module__ == name}


def test_kernels_are_found():
    """Discovery would pass an empty list to the test below."""
    found = {name.partition(".")[2] for name in NAMES if warp_modules(name)}
    assert {"kernels.deformation.gradients", "kernels.deformation.svd", "kernels.sdf.closest"} <= found
    assert {"kernels.sdf.inside", "kernels.features.face", "kernels.wind", "training.teachers.newton.kernels"} <= found


@pytest.mark.parametrize("name", NAMES)
def test_compiles_for_cuda(name, tmp_path):
    """A kernel that only its CPU backend can build would fail on the user's GPU, at its first launch."""
    for module in warp_modules(name).values():
        built = wp.compile_aot_module(module, arch=ARCHITECTURE, use_ptx=False, module_dir=tmp_path / module.name)
        binaries = [Path(path) for path in built if Path(path).suffix == ".cubin"]
        assert binaries
        assert all(path.stat().st_size > 1000 for path in binaries)
