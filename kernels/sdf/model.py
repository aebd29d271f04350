"""A packed batch of bodies as an argument of kernels.

Kernels and functions take an array that holds one `Bodies`, and read `bodies[0]`: the structure itself, of a thousand
bytes, would be copied in every call of a function.
"""

from __future__ import annotations

import warp as wp

from .tree import Tree


@wp.struct
class Bodies:
    """The memory of a packed batch of bodies."""

    meshes: wp.array[wp.uint64]  # Warp's mesh of each body; 0 where the trees of tree.py are searched in its place
    face_offsets: wp.array[wp.int32]
    faces: wp.array[wp.vec3i]  # packed vertex indices
    vertices: wp.array[wp.vec3]
    rings: wp.array2d[wp.int32]  # faces that share a corner or an edge, see nearest_face.rings_of
    ring_offsets: wp.array[wp.int32]  # first row of each body in `rings`; bodies of the same faces share theirs
    scattered: wp.array[wp.int32]  # whether a body has too many holes to be closed by caps
    loop_offsets: wp.array[wp.int32]  # loops of each body, see mesh.caps.Caps
    loops: wp.array[wp.int32]
    caps: wp.array[wp.vec3i]
    loop_size: wp.array[wp.vec2]
    tree: Tree  # of all bodies; without nodes on a GPU


_ON_CPU = """
#if defined(__CUDA_ARCH__)
    return 0;
#else
    return 1;
#endif
"""


@wp.func_native(_ON_CPU)
def on_cpu() -> int:
    """1 where kernels are compiled for a CPU. On a GPU the compiler leaves out what depends on it."""
    ...


@wp.func
def has_tree(bodies: wp.array[Bodies]) -> bool:
    """Whether the trees of tree.py are searched, not Warp's; false on every GPU."""
    return on_cpu() != 0 and bodies[0].tree.nodes.shape[0] > 0


@wp.func
def exists(bodies: wp.array[Bodies], b: int) -> bool:
    """Whether there is a body of this number."""
    return b >= 0 and b < bodies[0].meshes.shape[0]


@wp.func
def corners_of(bodies: wp.array[Bodies], b: int, face: int):
    """The corners, in float64, of a face that is counted within its body."""
    corner = bodies[0].faces[bodies[0].face_offsets[b] + face]
    vertices = bodies[0].vertices
    return wp.vec3d(vertices[corner[0]]), wp.vec3d(vertices[corner[1]]), wp.vec3d(vertices[corner[2]])
