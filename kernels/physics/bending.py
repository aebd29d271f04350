"""Bending energy: a spring on the dihedral angle of every inner edge, with its gradient.

    W = ½ k_b l (θ - θ⁰)² + ½ (c_b / h) l (θ - θ⁻)²,    θ = atan2((n_A × n_B) · ê, n_A · n_B)

The second term is viscosity within one implicit step. The gradient of the angle (Bridson, Marino and Fedkiw 2003,
"Simulation of Clothing with Folds and Wrinkles", section 4) is along the normals of the two faces:

    ∂θ/∂x_2 = -|e| N_A,   ∂θ/∂x_3 = -|e| N_B,   N = n / |n|²
    ∂θ/∂x_0 = -((x_2 - x_1)·ê N_A + (x_3 - x_1)·ê N_B),   ∂θ/∂x_1 = (x_2 - x_0)·ê N_A + (x_3 - x_0)·ê N_B

| symbol | code | what |
| --- | --- | --- |
| x_0, x_1; x_2, x_3 | `hinges` | ends of the edge; corners opposite to it in the faces A and B |
| e, ê | `edge`, `along` | x_1 - x_0 and its direction |
| n_A, n_B | `normal_a`, `normal_b` | e × (x_2 - x_0) and (x_3 - x_0) × e: normals with the length of twice the area |
| θ, θ⁰, θ⁻ | `angle`, `rest_angle`, `angle_before` | angle between normals: now, at rest, at the start of the step |
| k_b l | `stiffness` | bending stiffness [N] times rest length of the edge [m] |
| c_b l / h | `damping` | damping of the angle over the length of the step [N m] |

Angles are compared modulo a full turn, so that an edge that folds past 180° is not thrown open. An edge whose faces
have no area has no angle, and no force.
"""

from __future__ import annotations

import math

import warp as wp

from warpgarment.kernels import compiling

wp.set_module_options(compiling.options())

FLAT = wp.constant(wp.float64(1e-24))
"""Square of twice the area [m^4] below which a face has no normal."""
TURN = wp.constant(wp.float64(2.0 * math.pi))


@wp.func
def dihedral_angle(x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d) -> wp.float64:
    """θ, zero for flat cloth, positive for a convex edge: one that the normals turn away from."""
    edge = x1 - x0
    normal_a = wp.cross(edge, x2 - x0)
    normal_b = wp.cross(x3 - x0, edge)
    sine = wp.dot(wp.cross(normal_a, normal_b), edge)
    length = wp.length(edge)
    angle = wp.float64(0.0)
    if length > wp.float64(0.0):
        angle = wp.atan2(sine / length, wp.dot(normal_a, normal_b))
    return angle


@wp.func
def turned(difference: wp.float64) -> wp.float64:
    """A difference of angles within half a turn."""
    return difference - TURN * wp.round(difference / TURN)


@wp.kernel(enable_backward=False)
def bending_kernel(
    # Model:
    hinges: wp.array[wp.vec4i],
    rest_angle: wp.array[wp.float64],
    stiffness: wp.array[wp.float64],
    damping: wp.array[wp.float64],
    # In:
    vertices: wp.array[wp.vec3d],
    angle_before: wp.array[wp.float64],
    # Out:
    energy: wp.array[wp.float64],
    gradient: wp.array[wp.vec3d],  # of the vertices of the hinges, [4 H]
):
    i = wp.tid()
    hinge = hinges[i]
    x0 = vertices[hinge[0]]
    x1 = vertices[hinge[1]]
    x2 = vertices[hinge[2]]
    x3 = vertices[hinge[3]]
    edge = x1 - x0
    normal_a = wp.cross(edge, x2 - x0)
    normal_b = wp.cross(x3 - x0, edge)
    square_a = wp.dot(normal_a, normal_a)
    square_b = wp.dot(normal_b, normal_b)
    length = wp.length(edge)
    row = 4 * i
    if square_a < FLAT or square_b < FLAT or length == wp.float64(0.0):
        energy[i] = wp.float64(0.0)
        for k in range(4):
            gradient[row + k] = wp.vec3d()
    else:
        along = edge / length
        angle = wp.atan2(wp.dot(wp.cross(normal_a, normal_b), along), wp.dot(normal_a, normal_b))
        bent = turned(angle - rest_angle[i])
        moved = turned(angle - angle_before[i])
        energy[i] = wp.float64(0.5) * (stiffness[i] * bent * bent + damping[i] * moved * moved)
        moment = stiffness[i] * bent + damping[i] * moved
        a = (moment / square_a) * normal_a
        b = (moment / square_b) * normal_b
        gradient[row] = -(wp.dot(x2 - x1, along) * a + wp.dot(x3 - x1, along) * b)
        gradient[row + 1] = wp.dot(x2 - x0, along) * a + wp.dot(x3 - x0, along) * b
        gradient[row + 2] = -length * a
        gradient[row + 3] = -length * b


@wp.kernel(enable_backward=False)
def angle_kernel(
    # Model:
    hinges: wp.array[wp.vec4i],
    # In:
    vertices: wp.array[wp.vec3d],
    # Out:
    angle: wp.array[wp.float64],
):
    """θ of the positions."""
    i = wp.tid()
    hinge = hinges[i]
    angle[i] = dihedral_angle(vertices[hinge[0]], vertices[hinge[1]], vertices[hinge[2]], vertices[hinge[3]])
