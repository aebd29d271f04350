"""Flags with which kernels are compiled on a CPU, and modules that a rollout does not need."""

import importlib
import pkgutil

import pytest
import warp as wp

import warpgarment.kernels
from warpgarment.kernels import compiling

NAMES = [m.name for m in pkgutil.walk_packages(warpgarment.kernels.__path__, "warpgarment.kernels.")]


def test_modules_share_their_flags():
    """A module with flags of its own would read Warp's headers again, 1.4 seconds of a first rollout."""
    modules = {}
    for name in NAMES:
        for kernel in vars(importlib.import_module(name)).values():
            if isinstance(kernel, wp.Kernel) and kernel.func.__module__ == name:
                modules[kernel.module.name] = wp.get_module_options(kernel.module)["cpu_compiler_flags"]
    assert len(modules) > 40
    assert modules == dict.fromkeys(modules, compiling.options()["cpu_compiler_flags"])
    assert "-march=native" in compiling.options()["cpu_compiler_flags"]


def test_flags_of_the_user_are_kept(monkeypatch):
    """Who compiles for another processor than this one, through Warp's own setting, must get what was asked for."""
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", "")
    assert compiling.options(max_unroll=1) == {"cpu_compiler_flags": None, "max_unroll": 1}


@pytest.mark.parametrize(
    ("of", "kernel", "other"),
    [
        ("warpgarment.kernels.deformation.gradients", "inverse_rest_frames_kernel", "deformation_gradient_kernel"),
        ("warpgarment.kernels.poisson.kernels", "place", "place_adjoint"),
        ("warpgarment.kernels.linear.triangular", "substitute", "multiply_upper"),
    ],
)
def test_kernels_apart_do_not_compile_together(of, kernel, other):
    """A rollout would compile gradients, and launches of a GPU, that it never asks for."""
    file = importlib.import_module(of)
    assert getattr(file, kernel).module is not getattr(file, other).module
