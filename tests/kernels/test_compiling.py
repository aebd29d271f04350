"""Flags with which kernels are compiled on a CPU, and modules that a rollout does not need."""

import importlib
import pkgutil
import subprocess
import sys

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


def test_modules_with_loops_that_are_not_written_out_have_no_adjoints():
    """Gradients would be wrong without a warning: Warp's adjoint of such a loop reads what its last pass overwrote."""
    kernels = [k for name in NAMES for k in vars(importlib.import_module(name)).values() if isinstance(k, wp.Kernel)]
    rolled = {k for k in kernels if wp.get_module_options(k.module)["max_unroll"] == 1}
    assert len({k.module for k in rolled}) >= 5
    assert not [k.key for k in rolled if k.options.get("enable_backward", True)]


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
        ("warpgarment.kernels.deformation.next_frame", "keep_finite_kernel", "next_gradients_kernel"),
        ("warpgarment.kernels.dense.faces", "hear_kernel", "head_kernel"),
    ],
)
def test_kernels_apart_do_not_compile_together(of, kernel, other):
    """A rollout would compile gradients, and launches of a GPU, that it never asks for."""
    file = importlib.import_module(of)
    assert getattr(file, kernel).module is not getattr(file, other).module


AHEAD = """
import os, sys
import warp as wp
wp.config.kernel_cache_dir = sys.argv[1]
from warpgarment.kernels import compiling
from warpgarment.kernels.collision import contact_set
from warpgarment.kernels.features import carry

compiling._cores = lambda: int(sys.argv[2])
made = compiling.ahead(["collision.contact_set", "features.carry", "no.such.module"])
print(made, sorted(os.listdir(wp.config.kernel_cache_dir)))
"""


def test_modules_are_compiled_ahead_once_and_at_a_time(tmp_path):
    """Modules would be compiled one by one on many cores, or again and again. Two are made on two cores, into the
    cache; then there is nothing left to do. On one core they are left to their first launch."""
    said = []
    for cores in ("1", "2", "2"):
        command = [sys.executable, "-c", AHEAD, str(tmp_path), cores]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
        said.append(ran.stdout.splitlines()[-1].split(maxsplit=1))
    assert [made for made, _ in said] == ["0", "2", "0"]
    assert said[0][1] == "[]"
    assert "collision.contact_set_" in said[1][1]
    assert "features.carry_" in said[1][1]
    assert said[2][1] == said[1][1]
