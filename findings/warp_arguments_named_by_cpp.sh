#!/usr/bin/env bash
# Warp: arguments of kernels and fields of structs keep their names in C++, where some of them are no names
#
# Expected: any name that Python takes is a name in a kernel, as it is for its local variables: a kernel may call an
#           argument `new`, `this`, `default`, `template` or `operator`, a struct of settings may have a field `default`.
# Seen:     a variable `new` within a kernel is fine, since Warp calls it something else. An argument or a field of that
#           name is declared without an error, and the first launch ends with "CPU kernel build failed with error code
#           -1". What Python raises names neither the argument nor the kernel; the compiler's lines are on the standard
#           error output, about files that were generated. No kernel of that module runs.
# Versions: warp-lang 1.19.0, Python 3.11, x86-64.
# So:       names of arguments and fields are chosen so that they are none of C++'s words.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check warp-lang==1.19.0
cat >"$work/show.py" <<'PY'
import sys

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.config.kernel_cache_dir = sys.argv[1]


@wp.struct
class Settings:
    default: wp.float32


@wp.kernel(module="unique")
def variable(x: wp.array[wp.float32]):
    new = 2.0 * x[wp.tid()]
    x[wp.tid()] = new


@wp.kernel(module="unique")
def argument(x: wp.array[wp.float32], new: wp.float32):
    x[wp.tid()] = new


@wp.kernel(module="unique")
def field(x: wp.array[wp.float32], settings: Settings):
    x[wp.tid()] = settings.default


def launched(kernel: wp.Kernel, *more: object) -> str:
    x = wp.ones(3, dtype=wp.float32, device="cpu")
    try:
        wp.launch(kernel, dim=3, inputs=[x, *more], device="cpu")
    except Exception as error:
        return str(error)
    return f"ran, {x.numpy().tolist()}"


print(f"variable: {launched(variable)}")
print(f"argument: {launched(argument, 2.0)}")
print(f"field:    {launched(field, Settings())}")
PY
seen=$("$work/venv/bin/python" "$work/show.py" "$work/cache" 2>/dev/null)
echo "warp-lang 1.19.0"
echo "expected: all three run"
echo "seen:"
echo "$seen"
[ "$seen" = "variable: ran, [2.0, 2.0, 2.0]
argument: CPU kernel build failed with error code -1
field:    CPU kernel build failed with error code -1" ] || { echo "this has changed"; exit 1; }
