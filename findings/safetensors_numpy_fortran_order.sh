#!/usr/bin/env bash
# safetensors: arrays from NumPy that are not in C order are written scrambled, with the right shape
#
# Expected: save_file keeps values; or it refuses, as safetensors.torch does for tensors that are not contiguous.
# Seen:     safetensors.numpy copies the memory as it lies and writes the logical shape beside it. The left factor of
#           scipy.linalg.svd, which LAPACK leaves in Fortran order, comes back with its entries permuted: finite, the
#           right norm, the wrong matrix. safetensors 0.7.0 wrote it correctly.
# Versions: safetensors 0.8.0 (and 0.7.0 for comparison), scipy 1.17.1, numpy 2.4.6.
# So:       body shape bases, skinning weights and anything transposed go through np.ascontiguousarray before saving
#           (warpgarment/io/disk/cache.py), and are compared after. Files that 0.8.0 wrote from such arrays are wrong for good.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check safetensors==0.8.0 scipy==1.17.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import json
import sys
from pathlib import Path

import numpy as np
import safetensors
import scipy.linalg
from safetensors.numpy import load_file, save_file

if sys.argv[1:] == ["write"]:
    shapes = np.random.default_rng(0).standard_normal((300, 20))  # 100 vertices of 20 bodies, say
    basis, _, _ = scipy.linalg.svd(shapes, full_matrices=False)
    save_file({"basis": basis, "copy": np.ascontiguousarray(basis)}, "basis.safetensors")
    back = load_file("basis.safetensors")
    print(json.dumps({
        "version": safetensors.__version__,
        "c_order": bool(basis.flags.c_contiguous),
        "shape": back["basis"].shape == basis.shape,
        "norm": float(np.linalg.norm(back["basis"]) / np.linalg.norm(basis)),
        "same": bool(np.array_equal(back["basis"], basis)),
        "copy": bool(np.array_equal(back["copy"], basis)),
        "orthogonal": float(np.abs(back["basis"].T @ back["basis"] - np.eye(20)).max()),
    }))  # fmt: skip
    sys.exit()
new, old = (json.loads(Path(name).read_text()) for name in ("new.json", "old.json"))
print(f"left factor of scipy.linalg.svd, in C order: {new['c_order']}")
print(f"expected: the same values after save and load (safetensors {old['version']}: {old['same']})")
print(f"seen:     safetensors {new['version']}: same {new['same']}, shape {new['shape']}, norm x {new['norm']:.3f}, ")
print(f"          columns off orthogonal by {new['orthogonal']:.2f}; of a contiguous copy: same {new['copy']}")
still = (
    not new["c_order"] and new["shape"] and not new["same"] and new["copy"] and old["same"] and new["orthogonal"] > 0.1
)
sys.exit(0 if still else "no longer so: arrays in Fortran order are kept or refused")
PY
cd "$work"
"$work/venv/bin/python" show.py write >new.json
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check safetensors==0.7.0
"$work/venv/bin/python" show.py write >old.json
"$work/venv/bin/python" show.py
