"""What a first rollout loads."""

import subprocess
import sys

ROLLOUT = """
import sys
import warpgarment as wg

assets = wg.demo.assets()
dress = assets.garments["dress"]
simulator = wg.Simulator.from_pretrained("fast", device="cpu")
simulator.rollout(dress.garment, assets.collider, first_vertices=dress.first_vertices, frames=20)
print([name for name in ("torch._dynamo", "torch._inductor", "sympy", "matplotlib", "pxr") if name in sys.modules])
"""


def test_a_rollout_does_not_load_the_compiler_of_torch():
    """A first rollout would take two seconds and 70 MB more, for a compiler that it does not use."""
    ran = subprocess.run([sys.executable, "-c", ROLLOUT], capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "[]"


def test_modules_compiled_ahead_are_those_that_a_rollout_launches():
    """A first rollout would compile one module after the other, or modules in vain, on a machine of many cores. What
    Warp has loaded after a rollout is compared with what is named to be compiled first."""
    says = """
import warp as wp
from warpgarment.kernels import compiling

loaded = {name for name, module in wp._src.context.user_modules.items() if module.execs}
named = {f"warpgarment.kernels.{name}" for name in [*compiling.OF_A_FRAME, *simulator.network.launches]}
print(sorted(loaded ^ named))
"""
    ran = subprocess.run([sys.executable, "-c", ROLLOUT + says], capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "[]"
