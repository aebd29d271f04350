"""The kernels of this folder as other processors have them: with vectors half as wide, and with tiles of AMX."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from warpgarment.kernels.dense import products

pytestmark = [
    pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the flags name processors of this kind"),
    pytest.mark.skipif(not products.available(), reason="this processor has no vectors"),
]
HERE = Path(__file__).parent
AVX2 = """
import sys, pytest, torch, warp as wp
torch.cpu._is_amx_tile_supported = lambda: False
wp.config.cpu_compiler_flags = "-target-cpu x86-64-v3"
sys.exit(pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", *sys.argv[1:]]))
"""
AMX = """
import importlib, sys, torch, warp as wp
for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported", "_init_amx"):
    setattr(torch.cpu, name, lambda: True)
wp.config.cpu_compiler_flags = "-target-cpu sapphirerapids"
for name in ("products", "faces", "tokens", "turned", "trained.layer", "trained.encoder", "trained.head"):
    module = importlib.import_module("warpgarment.kernels.dense." + name)
    wp.compile_aot_module(wp.get_module(module.__name__), device="cpu", module_dir=sys.argv[1])
assert importlib.import_module("warpgarment.kernels.dense.products").ON_TILES
"""


def run(code: str, *arguments: str) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=HERE.parents[2], capture_output=True, text=True, timeout=600
    )
    assert ran.returncode == 0, (ran.stdout + ran.stderr)[-3000:]


def test_with_vectors_of_avx2():
    """Most desktop processors would get wrong numbers: what AVX-512 has instructions for is written out there."""
    run(AVX2, *(f"tests/{name}" for name in ("kernels/dense/test_faces.py", "kernels/dense/test_tokens.py")),
        "tests/nn/patches/test_trained.py",
        "tests/nn/patches/test_trained_encoder.py", "tests/nn/patches/test_trained_head.py")  # fmt: skip


def test_tiles_of_amx_compile(tmp_path):
    """Processors with tiles would fail at the first frame, which no other processor shows."""
    run(AMX, str(tmp_path))
