#!/usr/bin/env bash
# Newton: how far VBD cloth stretches is set by the number of iterations, not by its stiffness
#
# Expected: a strip that hangs by its upper edge gets longer by its weight over its stiffness: ten or a hundred times
#           stiffer, ten or a hundred times less.
# Seen:     at 10 substeps and 5 iterations it is 0.28 % longer at tri_ke 1e3, 1e4 and 1e5 alike (within a tenth of
#           that). With 10 iterations it is 0.15 %, at all three. What is measured is how far the iteration got, and so
#           it is in the wrong place: more iterations on a softer cloth is stiffer. Though it hangs straight, it also
#           begins to swing by itself, several centimetres in a second.
# Versions: newton 1.8.0, warp-lang 1.19.0, numpy 2.4.6.
# So:       a data set with "material" as an input, recorded so, has nothing to learn. Check the elongation of a strip
#           at both ends of the range of stiffness before recording.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 numpy==2.4.6
cat >"$work/show.py" <<'PY'
import sys

import newton
import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_device("cpu")
COLUMNS, ROWS, CELL = 2, 16, 0.025


def hang(stiffness, iterations):
    """Mean elongation [%] along the strip over the second half of a second, and its largest sideways motion [m]."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    builder.add_cloth_grid(
        pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), float(np.pi / 2)),
        vel=wp.vec3(0.0, 0.0, 0.0), dim_x=COLUMNS, dim_y=ROWS, cell_x=CELL, cell_y=CELL, mass=0.2 * CELL**2,
        tri_ke=stiffness, tri_ka=stiffness, tri_kd=0.0, edge_ke=1e-3, edge_kd=1e-4, particle_radius=0.004, fix_top=True,
    )  # fmt: skip
    builder.color()
    model = builder.finalize()
    solver = newton.solvers.SolverVBD(model, iterations=iterations)
    here, there, control, longer, sideways = model.state(), model.state(), model.control(), [], 0.0
    for frame in range(60):
        for _ in range(10):
            here.clear_forces()
            solver.step(here, there, control, None, 1 / 600)
            here, there = there, here
        at = here.particle_q.numpy().reshape(ROWS + 1, COLUMNS + 1, 3)
        sideways = max(sideways, float(np.abs(at[..., 1]).max()))
        if frame >= 30:
            longer.append(100 * (np.linalg.norm(np.diff(at, axis=0), axis=2).sum(0).mean() / (ROWS * CELL) - 1))
    return float(np.mean(longer)), sideways


print("newton", newton.__version__)
few = {k: hang(k, 5) for k in (1e3, 1e4, 1e5)}
more = {k: hang(k, 10) for k in (1e3, 1e4, 1e5)}
print("expected: elongation in proportion to 1 / tri_ke, at any number of iterations that is enough")
for name, table in (("5 iterations ", few), ("10 iterations", more)):
    print(
        f"seen:     {name}", ", ".join(f"{e:.3f} % at {k:.0e} (swings {1e2 * s:.0f} cm)" for k, (e, s) in table.items())
    )
alike = all(max(e for e, _ in t.values()) < 1.25 * min(e for e, _ in t.values()) for t in (few, more))
still = alike and all(few[k][0] > 1.5 * more[k][0] for k in few)
sys.exit(0 if still else "no longer so: stiffness changes the elongation, or iterations do not")
PY
cd "$work"
WARP_CACHE_PATH="$work/kernels" "$work/venv/bin/python" show.py
