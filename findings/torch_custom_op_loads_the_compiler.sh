#!/usr/bin/env bash
# PyTorch: the first call of a custom operator, and torch.eye under the meta device, load the whole compiler
#
# Expected: an operator made by torch.library.custom_op runs its Python function, and torch.eye on the meta device, with
#           which networks are built before their weights are read, makes a shape; torch.compile is used by neither.
# Seen:     each imports torch._dynamo when it first runs, eagerly, with some 800 modules (SymPy's among them), 76 MB, and
#           one to two seconds. The same operator made of torch.library.define and torch.library.impl
#           imports none of it.
# Versions: torch 2.13.0, numpy 2.4.6, Python 3.11, on the CPU. That the modules are there is asserted, and over 300 of
#           them; times and memory are printed.
# So:       kernels that are called in short processes (a command line, workers) register by define, impl, register_fake
#           and register_autograd (kernels/registered.py). A profile shows it as a slow first call of a fast operator.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check torch==2.13.0 numpy==2.4.6
cat >"$work/first.py" <<'PY'
import resource
import sys
import time

import torch


def double(x: torch.Tensor) -> torch.Tensor:
    return 2 * x


def custom_op():
    return torch.library.custom_op("shown::double", double, mutates_args=())


def define_and_impl():
    torch.library.define("shown::twice", "(Tensor x) -> Tensor")
    torch.library.impl("shown::twice", "default", double)
    return torch.ops.shown.twice


def eye_on_meta():
    def eye(x):
        with torch.device("meta"):
            assert torch.eye(3).shape == (3, 3)
        return 2 * x

    return eye


operator = globals()[sys.argv[1]]()
loaded = "torch._dynamo" in sys.modules  # not by registering it
modules, memory, began = len(sys.modules), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
assert operator(torch.ones(3)).tolist() == [2, 2, 2]
seconds = time.perf_counter() - began
more = len(sys.modules) - modules
megabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1e3
print(int(not loaded and "torch._dynamo" in sys.modules), more, f"{seconds:.2f}", f"{megabytes:.0f}")
PY
cd "$work"
still=0
for name in custom_op eye_on_meta define_and_impl; do
    read -r loads modules seconds megabytes < <("$work/venv/bin/python" first.py "$name" 2>/dev/null)
    echo "$name: first call loads the compiler: $loads, modules: $modules, seconds: $seconds, MB: $megabytes"
    case $name in
    define_and_impl) [ "$loads" = 0 ] && still=$((still + 1)) ;;
    *) [ "$loads" = 1 ] && [ "$modules" -gt 300 ] && still=$((still + 1)) ;;
    esac || true
done
"$work/venv/bin/python" -c 'import torch; print("torch", torch.__version__)'
echo "expected: 0 for all three"
if [ "$still" != 3 ]; then
    echo "no longer so: eager custom operators leave the compiler alone, or all operators load it"
    exit 1
fi
