#!/usr/bin/env bash
# Warp: on the CPU, conjugate gradients are many times faster when one system is called a batch of one
#
# Expected: warp.optim.linear.cg takes about the time of its one matrix product and two dot products an iteration, and
#           saying that the unknowns form one block changes nothing.
# Seen:     with 5,000 unknowns, unbatched, an iteration costs 15 to 20 ms (SciPy: 0.05 ms). With the same operator and
#           batch_offsets=[0, n] it is over ten times faster and ends at the same solution: the two paths reduce dot
#           products with different kernels, and the unbatched one is made for a GPU.
# Versions: warp-lang 1.19.0, scipy 1.17.1, numpy 2.4.6, on the CPU. The ratio is asserted (5 or more), not the times.
# So:       wrap the matrix in a LinearOperator with batch_offsets where the CPU matters, or write the loop as one block
#           of threads (kernels/linear/conjugate_gradients.py). A profile of the matrix product alone does not show it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check warp-lang==1.19.0 scipy==1.17.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys
import time

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg
import warp as wp
from warp.optim.linear import LinearOperator, aslinearoperator, cg
from warp.sparse import bsr_from_triplets

wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_device("cpu")
n, rounds = 5000, 40
a = sparse.diags([-1.0, 2.1, -1.0], [-1, 0, 1], shape=(n, n)).tocoo()
b = np.random.default_rng(0).standard_normal(n).astype(np.float32)
matrix = bsr_from_triplets(
    n, n, wp.array(a.row, dtype=int), wp.array(a.col, dtype=int), wp.array(a.data.astype(np.float32), dtype=float)
)
plain = aslinearoperator(matrix)
batch = LinearOperator(plain.shape, plain.dtype, plain.device, plain.matvec, batch_offsets=wp.array([0, n], dtype=int))


def solve(operator):
    """The solution after 40 iterations and the least of three times, in ms an iteration."""
    times = []
    for _ in range(4):  # the first compiles
        x, start = wp.zeros(n, dtype=float), time.perf_counter()
        cg(operator, wp.array(b), x, tol=0.0, atol=0.0, maxiter=rounds, check_every=0, use_cuda_graph=False)
        times.append(time.perf_counter() - start)
    return x.numpy(), 1e3 * min(times[1:]) / rounds


(x, slow), (y, fast) = solve(plain), solve(batch)
start = time.perf_counter()
scipy.sparse.linalg.cg(a.tocsr(), b, rtol=0, maxiter=rounds)
print("warp", wp.config.version)
print(f"SciPy: {1e3 * (time.perf_counter() - start) / rounds:.2f} ms an iteration")
print("expected: as is and as a batch of one alike")
print(
    f"seen:     {slow:.2f} ms as is, {fast:.2f} ms as a batch of one; the solutions differ by {np.abs(x - y).max():.0e}"
)
still = slow > 5 * fast and np.abs(x - y).max() < 1e-3
sys.exit(0 if still else "no longer so: unbatched conjugate gradients keep up on the CPU, or the solutions differ")
PY
cd "$work"
WARP_CACHE_PATH="$work/kernels" "$work/venv/bin/python" show.py
