#!/usr/bin/env bash
# Warp: flags for another processor are those of the compiler's frontend, not those of a compiler's command line
#
# Expected: wp.config.cpu_compiler_flags, whose default begins with -march=native, takes -march=haswell or -mavx2 as any
#           compiler does, for example to compile ahead of time for other machines than this one.
# Seen:     both end the compilation of the first kernel with "unknown argument". -march=native is read by Warp itself;
#           all else goes to Clang's frontend, which has -target-cpu haswell and -target-feature +avx2 for it. A function
#           in C++ then sees __AVX2__, which it does not without them.
# Versions: warp-lang 1.19.0, Python 3.11, x86-64.
# So:       kernels with vectors in C++ (wp.func_native) can be compiled, and tested, as other processors have them:
#           -target-cpu x86-64-v3 for AVX2, -target-cpu sapphirerapids for tiles (tests/kernels/dense).
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
wp.config.cpu_compiler_flags = sys.argv[2]


@wp.func_native("""
#if defined(__AVX2__)
    return 1;
#else
    return 0;
#endif
""")
def vectors() -> wp.int32: ...


@wp.kernel(enable_backward=False)
def ask(result: wp.array[wp.int32]):
    result[0] = vectors()


result = wp.zeros(1, dtype=wp.int32, device="cpu")
wp.compile_aot_module(wp.get_module("__main__"), device="cpu", module_dir=sys.argv[1])
if sys.argv[3] == "run":
    wp.launch(ask, dim=1, outputs=[result], device="cpu")
    print(result.numpy()[0])
PY
compiles() {  # FLAGS: yes or no
    if "$work/venv/bin/python" "$work/show.py" "$work/cache" "$1" compile >"$work/log" 2>&1; then echo yes; else echo no; fi
}
seen=""
for flags in "-march=haswell" "-mavx2" "-target-cpu haswell" "-target-feature +avx2"; do
    seen+="$(compiles "$flags") "
    if [ "$flags" = "-march=haswell" ]; then said=$(grep -m1 -o "unknown argument: '-march=haswell'" "$work/log" || true); fi
done
none=$("$work/venv/bin/python" "$work/show.py" "$work/plain" "" run 2>/dev/null | tail -1)
echo "warp-lang 1.19.0"
echo "expected: -march=haswell and -mavx2 compile"
echo "seen:     -march=haswell, -mavx2, -target-cpu haswell, -target-feature +avx2: $seen ($said); AVX2 without flags: $none"
[ "$seen" = "no no yes yes " ] && [ -n "$said" ] && [ "$none" = 0 ] || { echo "this has changed"; exit 1; }
