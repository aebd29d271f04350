"""The names of `import warpgarment`: each is there in a process that has used no other, and none before it is used."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import version

import pytest

import warpgarment as wg

HEAVY = {"torch", "warp", "numpy", "scipy", "safetensors", "PIL", "matplotlib", "huggingface_hub", "pxr"}


def _fresh(code: str) -> str:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_importing_imports_nothing_heavy():
    """`import warpgarment`, and its version, would take seconds: neither may import torch, Warp, NumPy or an extra."""
    code = "import sys, warpgarment; warpgarment.__version__; dir(warpgarment); print(*sys.modules)"
    loaded = {name.split(".")[0] for name in _fresh(code).split()}
    assert "warpgarment" in loaded
    assert not loaded & HEAVY


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes to fork")
def test_names_are_there_without_any_other():
    """A name exists only once another was used, as `wg.kernels` did after `wg.Simulator`. Each is looked up in
    a process that has imported other packages alone, forked so that these are loaded once."""
    code = """
import operator, os, sys, torch, warp, scipy.sparse.linalg, safetensors.torch, warpgarment
assert not [name for name in sys.modules if name.startswith("warpgarment.")]
for name in ["kernels", "kernels.sdf.BodyMeshes", *warpgarment.__all__]:
    child = os.fork()
    if not child:
        try:
            operator.attrgetter(name)(warpgarment)
        except AttributeError:
            os._exit(1)
        os._exit(0)
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        print(name)
"""
    assert _fresh(code) == ""


def test_a_rollout_loads_no_more_than_it_needs():
    """It would start later, and take more memory: readers of motion capture, SciPy's trees, the kernels of layers and
    of physics, and torch's compiler are for others."""
    code = """
import sys, warpgarment as wg
assets = wg.demo.assets()
dress = assets.garments["dress"]
sim = wg.Simulator.from_pretrained("fast", device="cpu")
sim.rollout(dress.garment, assets.collider, first_vertices=dress.first_vertices, frames=2)
print(*sys.modules)
"""
    loaded = set(_fresh(code).split())
    assert "warpgarment.kernels.collision.solver" in loaded
    heavy = {"scipy.spatial", "scipy.special", "warpgarment.kernels.cloth", "warpgarment.kernels.physics",
             "warpgarment.bodies.moved", "torch._dynamo"}  # fmt: skip
    assert not loaded & heavy


@pytest.mark.parametrize("on", [True, False])
def test_imports_leave_the_garbage_collector_as_it_was(on):
    """A program would run without collections ever after, or with those that it has switched off; and objects from
    before the import would never be collected."""
    code = f"import gc, warpgarment as wg; {'gc.enable()' if on else 'gc.disable()'}; wg.Simulator;"
    assert _fresh(f"{code} print(gc.isenabled(), gc.get_freeze_count())") == f"{on} 0"


def test_version_is_that_of_the_installed_package():
    """A bug report, or a cache, would hold the version of something else, or none."""
    assert _fresh("import warpgarment; print(warpgarment.__version__)") == version("warpgarment") != ""


def test_kernels_are_reached_by_attribute():
    """What is not there is anything but an AttributeError, which `hasattr` needs."""
    assert wg.kernels.sdf.BodyMeshes.__module__.startswith("warpgarment.kernels")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = wg.kernels.nothing


def test_both_networks_are_public():
    """The type of the network that ships as `fast` cannot be named."""
    assert type(wg.Simulator.from_pretrained("fast", device="cpu").network) is wg.PatchTransformer
