#!/usr/bin/env bash
# SciPy and NumPy: importing scipy.sparse imports NumPy's Fortran wrapper generator, its tests' tools and unittest
#
# Expected: NumPy loads numpy.f2py, numpy.testing, numpy.typing and the like when they are asked for, and sparse
#           matrices ask for none of them. `import numpy` alone shows that it does.
# Seen:     after `import scipy.sparse` all of them are loaded, and unittest with them. SciPy's copy of
#           array-api-compat imports all public names of NumPy, and NumPy 2 lists these lazy modules among them: 30 to
#           120 ms of the import, and some 10 MB.
# Versions: scipy 1.17.1, numpy 2.4.6, Python 3.11.
# So:       a program that must start quickly imports scipy.sparse where it is used; to leave out scipy.linalg or
#           scipy.spatial saves nothing of this, since all of them import the same file. A profile by
#           `python -X importtime` shows f2py below scipy, where nobody looks for it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check scipy==1.17.1 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys
import time

import numpy

LAZY = "numpy.f2py", "numpy.testing", "numpy.typing", "numpy.ctypeslib", "unittest"


def loaded():
    return [name for name in LAZY if name in sys.modules]


before = loaded()
start = time.perf_counter()
for name in LAZY:
    __import__(name)
alone = time.perf_counter() - start
for name in [module for module in sys.modules if module.startswith(LAZY)]:
    del sys.modules[name]
for name in LAZY[:4]:
    vars(numpy).pop(name.partition(".")[2], None)

start = time.perf_counter()
import scipy  # noqa: E402
import scipy.sparse  # noqa: E402

whole = time.perf_counter() - start
after = loaded()
print("scipy", scipy.__version__, "numpy", numpy.__version__)
print("expected: none of", ", ".join(LAZY), "by either import")
print("seen:     after numpy:", before, "- after scipy.sparse:", after)
print(f"          these modules alone {1e3 * alone:.0f} ms, scipy.sparse with them {1e3 * whole:.0f} ms")
raise SystemExit(0 if not before and len(after) == len(LAZY) else "this has changed")
PY
"$work/venv/bin/python" "$work/show.py"
