"""Friction as an energy: smooth at rest, of constant force beyond a short way.

    W = μ p f(s),    f(s) = s - ε / 3,    and for s < ε:  s² / ε - s³ / (3 ε²)

(Li et al. 2020, "Incremental Potential Contact", section 5, without the constant where s < ε.) Its derivative rises
smoothly from 0 to μ p.

| symbol | code | what |
| --- | --- | --- |
| s | length of `slid` | way along the surface since the start of the step [m] |
| μ p | `force` | largest friction force [N] |
| ε | `slip` | way [m] below which friction is not yet full |
"""

from __future__ import annotations

import warp as wp


@wp.func
def friction_energy(slid: wp.vec3d, force: wp.float64, slip: wp.float64) -> wp.float64:
    """W [J]."""
    s = wp.length(slid)
    w = force * (s - slip / wp.float64(3.0))
    if s < slip:
        r = s / slip
        w = force * s * (r - r * r / wp.float64(3.0))
    return w


@wp.func
def friction_gradient(slid: wp.vec3d, force: wp.float64, slip: wp.float64) -> wp.vec3d:
    """∂W by the end of the way [N]."""
    s = wp.length(slid)
    by = force / wp.max(s, slip)
    if s < slip:
        by = force * (wp.float64(2.0) - s / slip) / slip
    return by * slid
