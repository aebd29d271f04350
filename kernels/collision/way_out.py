r"""The way out of a body that reaches into itself: a hand in a thigh, an arm pressed against the ribs.

Where parts of a body overlap, the nearest surface of a point inside may belong to another part and lie in the body too.
A contact with it would push cloth from one part into the other, and the next one back again. Whether a way leads out is
seen on a ray along it, by counting: in a body with winding number w, the ray crosses the surface w times more often
outwards (+1) than inwards (-1), and it leaves the body where it has done so w times more often for the first time:

    t* = min { t_k : Σ_{j≤k} s_j = w },    w = Σ_j s_j,    s_j = sign(n_j · r)

Of ten ways, along the contact's direction, against it, across it and between those, the shortest is taken if it is
shorter than `LONGEST`. Where all are longer, the contact is left as it is: cloth that is led through a whole limb would
look worse than cloth that stays between the two parts, where nobody sees it.

| symbol | code | what |
| --- | --- | --- |
| r | `way` | unit vector |
| t_k, s_j | `far`, `turned` | distance of a crossing along the way [m]; its sign |
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels.sdf.first_hit import first_hit
from warpgarment.kernels.sdf.model import Bodies

LONGEST = wp.constant(wp.float32(0.05))
"""Longest way out [m]: somewhat more than the thickness of a hand."""
FAR = wp.constant(wp.float32(1.0e6))
CROSSINGS = wp.constant(24)
"""Number of crossings that are followed on a ray; parts that overlap have a handful."""
BEHIND = wp.constant(wp.float32(1.0e-5))
"""How far behind a crossing the ray goes on [m]."""


@wp.func
def length_of_way(bodies: wp.array[Bodies], b: int, point: wp.vec3, way: wp.vec3) -> float:
    """Distance from a point inside a body to where a ray leaves it [m]; -1 where it is not inside, along this ray."""
    turns = wp.int32(0)
    leaves = wp.vec4(-1.0)  # where the sum of s_j reaches 1, 2, 3 and 4 for the first time
    far = wp.float32(0.0)
    for _k in range(CROSSINGS):
        face, step, turned = first_hit(bodies, b, point + far * way, way, FAR)
        if face < 0:
            break
        far += step
        if turned > 0.0:
            turns += 1
            if turns >= 1 and turns <= 4:
                if leaves[turns - 1] < 0.0:
                    leaves[turns - 1] = far
        else:
            turns -= 1
        far += BEHIND
    length = wp.float32(-1.0)
    if turns >= 1 and turns <= 4:
        length = leaves[turns - 1]
    return length


@wp.func
def way_out(bodies: wp.array[Bodies], b: int, point: wp.vec3, normal: wp.vec3, edge: wp.vec3):
    """The shortest of ten ways out of a body.

    Args:
        bodies: The bodies.
        b: The body.
        point: A position inside [m].
        normal: Direction of a contact there, a unit vector.
        edge: Any direction that is not parallel to it, such as an edge of the face that is touched.

    Returns:
        Direction, a unit vector, and length [m]; the length is -1 where none is shorter than `LONGEST`.
    """
    one = wp.normalize(wp.cross(normal, edge))
    other = wp.cross(normal, one)
    best = wp.vec3()
    least = LONGEST
    for k in range(10):
        way = normal
        if k == 1:
            way = -normal
        elif k >= 2:
            across = wp.where(k % 4 < 2, one, other)
            way = wp.where(k % 2 == 0, across, -across)
            if k >= 6:
                way = wp.normalize(way + normal)
        length = length_of_way(bodies, b, point, way)
        if length >= 0.0 and length < least:
            least = length
            best = way
    return best, wp.where(least < LONGEST, least, -1.0)


@wp.func
def leads_out(bodies: wp.array[Bodies], b: int, point: wp.vec3, way: wp.vec3) -> bool:
    """Whether a point is outside of a body, seen along a ray from it."""
    return length_of_way(bodies, b, point, way) < 0.0
