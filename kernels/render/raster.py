"""Rasterisation of triangles into a depth buffer.

A view is a perspective camera or an orthographic one (a light, for its shadows). A pixel keeps its nearest triangle
in one 64-bit word, closeness in the upper half and face index plus one in the lower, so that a single atomic maximum
decides and the result does not depend on the order of threads. The word of an empty pixel is 0.

    closeness   perspective 1/z, orthographic z_far - z: both are affine in screen space and grow towards the eye
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warpgarment.kernels import compiling, launch  # noqa: F401  (launch quietens Warp)

wp.set_module_options(compiling.options(enable_backward=False))

_FAR = wp.constant(100.0)  # depth of an orthographic view [m]


@wp.struct
class View:
    """An eye [m] and its picture plane: unit directions to the right, up and forward, and the size in pixels.

    `scale` is the focal length in pixels (perspective) or the number of pixels per metre (orthographic).
    """

    eye: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    scale: float
    width: int
    height: int
    perspective: bool


@wp.func
def project(view: View, p: wp.vec3) -> wp.vec3:
    """Pixel column, pixel row, closeness (not positive behind the eye)."""
    d = p - view.eye
    z = wp.dot(d, view.forward)
    scale = view.scale
    closeness = _FAR - z
    if view.perspective:
        if z < 1.0e-3:
            return wp.vec3(0.0, 0.0, -1.0)
        scale = view.scale / z
        closeness = 1.0 / z
    x = 0.5 * float(view.width) + scale * wp.dot(d, view.right)
    y = 0.5 * float(view.height) - scale * wp.dot(d, view.up)
    return wp.vec3(x, y, closeness)


@wp.func
def barycentric(a: wp.vec3, b: wp.vec3, c: wp.vec3, x: float, y: float) -> wp.vec3:
    """Screen-space barycentric coordinates of the pixel centre; (-1, -1, -1) for a triangle seen edge-on."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if wp.abs(area) < 1.0e-12:
        return wp.vec3(-1.0, -1.0, -1.0)
    v = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
    w = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
    return wp.vec3(1.0 - v - w, v, w)


@wp.kernel
def project_kernel(
    # In:
    view: View,
    vertices: wp.array(dtype=wp.vec3),
    # Out:
    screen_out: wp.array(dtype=wp.vec3),
):
    tid = wp.tid()
    screen_out[tid] = project(view, vertices[tid])


@wp.func
def face_of(word: wp.int64) -> int:
    return int(word & wp.int64(0xFFFFFFFF)) - 1


@wp.func
def closeness_of(word: wp.int64) -> float:
    return wp.cast(wp.int32(word >> wp.int64(32)), wp.float32)


@wp.func
def ray(view: View, x: float, y: float) -> wp.vec3:
    """The vector from the eye to a pixel of the picture plane at depth 1."""
    u = (x - 0.5 * float(view.width)) / view.scale
    v = (y - 0.5 * float(view.height)) / view.scale
    return view.forward + u * view.right - v * view.up


@wp.kernel
def raster_kernel(
    # In:
    view: View,
    screen: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=wp.int32),
    # Out:
    buffer_out: wp.array2d(dtype=wp.int64),
):
    """One thread per triangle visits the pixels of its bounding box."""
    tid = wp.tid()
    a, b, c = screen[faces[tid, 0]], screen[faces[tid, 1]], screen[faces[tid, 2]]
    if a[2] <= 0.0 or b[2] <= 0.0 or c[2] <= 0.0:
        return
    low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
    if not (high[0] >= 0.0 and high[1] >= 0.0 and low[0] <= float(view.width) and low[1] <= float(view.height)):
        return  # outside the picture, or not a number
    x0, y0 = int(wp.max(low[0] - 0.5, 0.0)), int(wp.max(low[1] - 0.5, 0.0))
    x1 = int(wp.min(high[0] + 0.5, float(view.width - 1)))
    y1 = int(wp.min(high[1] + 0.5, float(view.height - 1)))
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if wp.abs(area) < 1.0e-12:
        return
    scale = 1.0 / area
    v_x, v_y = scale * (c[1] - a[1]), scale * (a[0] - c[0])  # per pixel: how the coordinates of b and c grow
    w_x, w_y = scale * (a[1] - b[1]), scale * (b[0] - a[0])
    for y in range(y0, y1 + 1):
        dy = float(y) + 0.5 - a[1]
        for x in range(x0, x1 + 1):
            dx = float(x) + 0.5 - a[0]
            v = v_x * dx + v_y * dy
            w = w_x * dx + w_y * dy
            if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
                closeness = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
                word = (wp.int64(wp.cast(closeness, wp.int32)) << wp.int64(32)) | wp.int64(tid + 1)
                wp.atomic_max(buffer_out, y, x, word)


def rasterise(view: View, vertices: wp.array, faces: wp.array, device: Any = "cpu") -> tuple[wp.array, wp.array]:
    """Projects and rasterises triangles.

    Args:
        view: View from which the triangles are seen; `width` x `height` is the size of the buffer in pixels.
        vertices: Vertex positions [m], wp.vec3 [V].
        faces: Vertex indices, int32 [F, 3 or more]; the first three columns are the corners.
        device: Warp device of the arrays.

    Returns:
        Pixel column, pixel row and closeness of each vertex, wp.vec3 [V]; the word of each pixel as described in the
        module's docstring, int64 [height, width].
    """
    screen = wp.empty(len(vertices), dtype=wp.vec3, device=device)
    buffer = wp.zeros((view.height, view.width), dtype=wp.int64, device=device)
    wp.launch(project_kernel, dim=len(vertices), inputs=[view, vertices], outputs=[screen], device=device)
    wp.launch(raster_kernel, dim=len(faces), inputs=[view, screen, faces], outputs=[buffer], device=device)
    return screen, buffer
