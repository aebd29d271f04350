#!/usr/bin/env bash
# Ruff and Warp: a fix that ruff calls safe turns a kernel's variable into a constant, and the kernel no longer compiles
#
# Expected: `ruff check --select UP --fix` changes nothing that a program does. Rule UP018 replaces `int(0)` by `0`, which
#           is the same value in Python, and the fix is applied without --unsafe-fixes.
# Seen:     in a Warp kernel `int(0)` declares a variable and `0` a constant. A kernel that adds up in a loop over a
#           length known at the launch gives its sum before the fix; after it, the launch raises WarpCodegenError
#           ("Error mutating a constant total inside a dynamic loop"). Nothing fails before the kernel is launched.
# Versions: warp-lang 1.19.0, ruff 0.17.6.
# So:       write wp.int32(0) and wp.float32(0.0) in kernels, which ruff leaves alone, or switch UP018 off for them; and
#           compile every kernel in the tests after a lint with --fix.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check warp-lang==1.19.0 ruff==0.17.6 numpy
cat >"$work/plain.py" <<'PY'
import sys

import warp as wp

wp.config.quiet = True
wp.config.kernel_cache_dir = sys.argv[1]


@wp.kernel
def add_up(values: wp.array(dtype=int), out: wp.array(dtype=int)):
    total = int(0)
    for k in range(values.shape[0]):
        total += values[k]
    out[0] = total


values, out = wp.array([1, 2, 3], dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
try:
    wp.launch(add_up, 1, [values, out], device="cpu")
    print("sum", out.numpy()[0])
except Exception as error:
    print(type(error).__name__, "mutating a constant" in str(error))
PY
sed 's/int(0)/wp.int32(0)/' "$work/plain.py" >"$work/typed.py"
cp "$work/plain.py" "$work/fixed.py"
cp "$work/typed.py" "$work/typed_fixed.py"
"$work/venv/bin/ruff" check --quiet --isolated --select UP018 --fix "$work/fixed.py" "$work/typed_fixed.py"
grep -q "total = 0$" "$work/fixed.py"
for name in plain fixed typed_fixed; do
    echo "$name: $("$work/venv/bin/python" "$work/$name.py" "$work/cache" 2>/dev/null | tail -n 1)"
done | tee "$work/seen"
diff "$work/seen" - <<'SEEN'
plain: sum 6
fixed: WarpCodegenError True
typed_fixed: sum 6
SEEN
