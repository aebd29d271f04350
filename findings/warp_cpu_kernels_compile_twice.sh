#!/usr/bin/env bash
# Warp: a kernel of one dimension is compiled twice for the CPU; one that asks for two indices, once
#
# Expected: how a kernel asks for its index, i = wp.tid() or i, _ = wp.tid(), matters as little to the time that it
#           takes to compile as it does to the result. A launch over n threads is the same for both.
# Seen:     with i = wp.tid() the object file holds every instruction twice: once for arrays whose elements are next to
#           each other, once for any. A kernel of some length takes 1.3 to 1.9 times as long to compile for that, and its
#           object file is nearly twice as large. With i, _ = wp.tid() it is compiled once, and gives the same bits.
#           Kernels that are bound by arithmetic or by a search gain nothing from the second copy.
# Versions: warp-lang 1.19.0, NumPy 2.4.6, Python 3.11, x86-64.
# So:       long kernels that are compiled on users' machines are better off with i, _ = wp.tid().
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.config.kernel_cache_dir = sys.argv[1]


@wp.kernel(enable_backward=False, module="unique")
def one_index(given: wp.array[wp.mat44d], result: wp.array[wp.mat44d]):
    i = wp.tid()
    m = given[i]
    for k in range(given.shape[0]):
        m = m * given[k]
        for _sweep in range(12):  # something to compile: Newton's iteration towards the nearest orthogonal matrix
            m = wp.float64(0.5) * (m + wp.transpose(wp.inverse(m)))
    result[i] = m


@wp.kernel(enable_backward=False, module="unique")
def two_indices(given: wp.array[wp.mat44d], result: wp.array[wp.mat44d]):
    i, _ = wp.tid()
    m = given[i]
    for k in range(given.shape[0]):
        m = m * given[k]
        for _sweep in range(12):  # something to compile: Newton's iteration towards the nearest orthogonal matrix
            m = wp.float64(0.5) * (m + wp.transpose(wp.inverse(m)))
    result[i] = m


@wp.kernel(enable_backward=False, module="unique")
def first(x: wp.array[wp.float32]):
    x[wp.tid()] = 1.0


x = wp.zeros(1, dtype=wp.float32, device="cpu")
wp.launch(first, dim=1, inputs=[x], device="cpu")  # the compiler has read its headers after this
given = np.eye(4) + 0.1 * np.random.default_rng(0).normal(size=(5, 4, 4))
seconds, sizes, results = [], [], []
for kernel in (one_index, two_indices):
    before = set(Path(sys.argv[1]).rglob("*.o"))
    result = wp.zeros(5, dtype=wp.mat44d, device="cpu")
    began = time.process_time()
    inputs = [wp.array(given, dtype=wp.mat44d, device="cpu")]
    wp.launch(kernel, dim=5, inputs=inputs, outputs=[result], device="cpu")
    seconds.append(time.process_time() - began)
    sizes.append(sum(path.stat().st_size for path in set(Path(sys.argv[1]).rglob("*.o")) - before))
    results.append(result.numpy())
print("expected: the same size and time for both, and the same result")
print(
    f"seen:     object files of {sizes[0]:,} and {sizes[1]:,} bytes, {sizes[0] / sizes[1]:.2f} times; "
    f"{seconds[0]:.2f} and {seconds[1]:.2f} s to compile; same bits: {np.array_equal(*results)}"
)
sys.exit(not (sizes[0] > 1.5 * sizes[1] and seconds[0] > 1.1 * seconds[1] and np.array_equal(*results)))
PY
echo "warp-lang 1.19.0"
"$work/venv/bin/python" "$work/show.py" "$work/cache" || { echo "this has changed"; exit 1; }
