"""Shading of rasterised triangles, with one thread per pixel.

The scene has a warm key light with a soft shadow from its depth buffer, a cool fill light, a sky that darkens in
creases, and a floor.
With normal n, key direction l and fill direction f, in linear light:

    radiance = colour * (sky(n) * openness + key * lit * max(n.l, 0) + fill * max(n.f, 0)) + rim
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warpgarment.kernels import compiling

from .raster import View, barycentric, closeness_of, face_of, project, rasterise, ray

wp.set_module_options(compiling.options(enable_backward=False))

_TAPS = wp.constant(12)  # occlusion samples a pixel
_GOLDEN = wp.constant(2.399963)  # golden angle [rad]: a spiral of taps without visible direction


@wp.struct
class Stage:
    """Lights, background and floor.

    Colours are in linear light. `key` and `fill` are unit directions towards the lights; `floor_height`, `floor_fade`,
    `focus` and `occlusion_radius` are in metres.
    """

    key: wp.vec3
    key_color: wp.vec3
    fill: wp.vec3
    fill_color: wp.vec3
    sky: wp.vec3
    ground: wp.vec3
    top: wp.vec3
    bottom: wp.vec3
    floor_color: wp.vec3
    floor_height: float
    floor_fade: float
    focus: wp.vec3
    has_floor: bool
    occlusion_radius: float


@wp.kernel
def vertex_normal_kernel(
    # In:
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=wp.int32),
    # Out:
    normals_out: wp.array(dtype=wp.vec3),
):
    """Adds each face's area-weighted normal to its corners; the shading pass normalises the sums."""
    tid = wp.tid()
    i, j, k = faces[tid, 0], faces[tid, 1], faces[tid, 2]
    n = wp.cross(vertices[j] - vertices[i], vertices[k] - vertices[i])
    wp.atomic_add(normals_out, i, n)
    wp.atomic_add(normals_out, j, n)
    wp.atomic_add(normals_out, k, n)


@wp.func
def _lit(light: View, shadow_map: wp.array2d(dtype=wp.int64), p: wp.vec3, bias: float) -> float:
    """Share of a 4x4 neighbourhood of the shadow map that lets the key light through to p."""
    s = project(light, p)
    lit = wp.float32(0.0)
    for j in range(4):
        for i in range(4):
            x, y = int(wp.floor(s[0])) + i - 2, int(wp.floor(s[1])) + j - 2
            if x < 0 or y < 0 or x >= light.width or y >= light.height:
                lit += 1.0
            elif closeness_of(shadow_map[y, x]) < s[2] + bias:
                lit += 1.0
    return lit / 16.0


@wp.func
def _occlusion(
    view: View,
    stage: Stage,
    buffer: wp.array2d(dtype=wp.int64),
    x: int,
    y: int,
    closeness: float,
    p: wp.vec3,
    n: wp.vec3,
) -> float:
    """Openness of p, from the depth buffer alone; 1 if nothing near p rises above its tangent plane."""
    radius = stage.occlusion_radius
    reach = radius * view.scale * closeness
    blocked = wp.float32(0.0)
    for k in range(_TAPS):
        r = reach * wp.sqrt((float(k) + 0.5) / float(_TAPS))
        px = x + int(r * wp.cos(float(k) * _GOLDEN))
        py = y + int(r * wp.sin(float(k) * _GOLDEN))
        if px >= 0 and py >= 0 and px < view.width and py < view.height:
            other = closeness_of(buffer[py, px])
            if other > 0.0:
                d = view.eye + ray(view, float(px) + 0.5, float(py) + 0.5) / other - p
                gap = wp.length(d)
                rise = wp.dot(n, d) / (gap + 1.0e-6) - 0.12  # the margin hides the facets of coarse meshes
                blocked += wp.max(rise, 0.0) * wp.clamp(2.0 - gap / radius, 0.0, 1.0)
    return wp.max(1.0 - 1.9 * blocked / float(_TAPS), 0.15)


@wp.func
def _backdrop(view: View, stage: Stage, y: int) -> wp.vec3:
    return wp.lerp(stage.top, stage.bottom, float(y) / float(view.height))


@wp.func
def _floor(
    view: View, stage: Stage, light: View, shadow_map: wp.array2d(dtype=wp.int64), ray: wp.vec3, backdrop: wp.vec3
) -> wp.vec3:
    """The floor with a half-metre grid and the key light's shadow, faded into the backdrop away from the focus."""
    if not stage.has_floor or ray[1] > -1.0e-3 or view.eye[1] <= stage.floor_height:
        return backdrop
    p = view.eye + ray * ((stage.floor_height - view.eye[1]) / ray[1])
    away = wp.length(p - wp.vec3(stage.focus[0], stage.floor_height, stage.focus[2])) / stage.floor_fade
    if away >= 1.0:
        return backdrop
    color = stage.floor_color
    gx, gz = 2.0 * p[0], 2.0 * p[2]
    if wp.min(wp.abs(gx - wp.round(gx)), wp.abs(gz - wp.round(gz))) < 0.012:
        color = 0.93 * color
    color = color * (0.62 + 0.38 * _lit(light, shadow_map, p, 1.0 / light.scale))
    strength = 1.0 - away * away * (3.0 - 2.0 * away)
    return wp.lerp(backdrop, color, strength)


@wp.kernel
def shade_kernel(
    # In:
    view: View,
    light: View,
    stage: Stage,
    vertices: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3),
    screen: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=wp.int32),
    buffer: wp.array2d(dtype=wp.int64),
    shadow_map: wp.array2d(dtype=wp.int64),
    # Out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Linear colour of one pixel. A row of `faces` holds three corners and whether the back of the face is a lining."""
    y, x = wp.tid()
    px, py = float(x) + 0.5, float(y) + 0.5
    face = face_of(buffer[y, x])
    if face < 0:
        image_out[y, x] = _floor(view, stage, light, shadow_map, ray(view, px, py), _backdrop(view, stage, y))
        return

    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    a, b, c = screen[i], screen[j], screen[k]
    bary = wp.cw_mul(barycentric(a, b, c, px, py), wp.vec3(a[2], b[2], c[2]))  # perspective-correct
    bary = bary / (bary[0] + bary[1] + bary[2])
    p = bary[0] * vertices[i] + bary[1] * vertices[j] + bary[2] * vertices[k]
    color = bary[0] * colors[i] + bary[1] * colors[j] + bary[2] * colors[k]
    n = wp.normalize(bary[0] * normals[i] + bary[1] * normals[j] + bary[2] * normals[k])
    to_eye = wp.normalize(view.eye - p)
    flat = wp.cross(vertices[j] - vertices[i], vertices[k] - vertices[i])
    if wp.dot(flat, to_eye) < 0.0:
        n = -n
        if faces[face, 3] != 0:
            color = 0.72 * color

    sky = wp.lerp(stage.ground, stage.sky, 0.5 + 0.5 * n[1])
    radiance = sky * _occlusion(view, stage, buffer, x, y, closeness_of(buffer[y, x]), p, n)
    shadow = wp.float32(0.0)
    if wp.dot(n, stage.key) > -0.15:
        texel = 1.0 / light.scale
        shadow = _lit(light, shadow_map, p + 3.0 * texel * n, 2.0 * texel)  # off the surface, which would shade p
    # The key light reaches a little past the terminator, as it does on cloth and skin.
    radiance += stage.key_color * (shadow * wp.max((wp.dot(n, stage.key) + 0.15) / 1.15, 0.0))
    radiance += stage.fill_color * wp.max(wp.dot(n, stage.fill), 0.0)
    grazing = 1.0 - wp.max(wp.dot(n, to_eye), 0.0)
    image_out[y, x] = wp.cw_mul(color, radiance) + (0.10 * grazing * grazing * grazing) * stage.sky


@wp.func
def _srgb(u: float) -> float:
    u = wp.clamp(u, 0.0, 1.0)
    if u < 0.0031308:
        return 12.92 * u
    return 1.055 * wp.pow(u, 1.0 / 2.4) - 0.055


@wp.kernel
def resolve_kernel(
    # In:
    image: wp.array2d(dtype=wp.vec3),
    samples: int,
    # Out:
    pixels_out: wp.array3d(dtype=wp.uint8),
):
    """Box filter over samples x samples, then sRGB bytes."""
    y, x = wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for j in range(samples):
        for i in range(samples):
            total += image[y * samples + j, x * samples + i]
    total = total / float(samples * samples)
    for channel in range(3):
        pixels_out[y, x, channel] = wp.uint8(255.0 * _srgb(total[channel]) + 0.5)


def render(
    vertices: Any, faces: Any, colors: Any, view: View, light: View, stage: Stage, *, samples: int, device: Any = "cpu"
) -> Any:
    """Draws one picture.

    Args:
        vertices: Vertex positions [m], NumPy float32 [V, 3].
        faces: Three corners, and 1 where the back of the face is a lining, which is drawn darker, NumPy int32 [F, 4].
        colors: Vertex colours in linear light, NumPy float32 [V, 3].
        view: The camera, with `width` and `height` in samples.
        light: Orthographic view of the key light.
        stage: Lights, backdrop and floor.
        samples: Number of samples per pixel in each direction, a divisor of `view.width` and `view.height`.
        device: Warp device.

    Returns:
        sRGB picture, NumPy uint8 [height / samples, width / samples, 3].
    """
    v: wp.array[wp.vec3] = wp.array(vertices, dtype=wp.vec3, device=device)
    c: wp.array[wp.vec3] = wp.array(colors, dtype=wp.vec3, device=device)
    f: wp.array[wp.int32] = wp.array(faces, dtype=wp.int32, device=device)
    normals = wp.zeros(len(vertices), dtype=wp.vec3, device=device)
    wp.launch(vertex_normal_kernel, dim=len(faces), inputs=[v, f], outputs=[normals], device=device)
    screen, buffer = rasterise(view, v, f, device)
    _, shadow_map = rasterise(light, v, f, device)
    image = wp.empty((view.height, view.width), dtype=wp.vec3, device=device)
    wp.launch(
        shade_kernel,
        dim=image.shape,
        inputs=[view, light, stage, v, normals, c, screen, f, buffer, shadow_map],
        outputs=[image],
        device=device,
    )
    pixels = wp.empty((view.height // samples, view.width // samples, 3), dtype=wp.uint8, device=device)
    wp.launch(resolve_kernel, dim=pixels.shape[:2], inputs=[image, samples], outputs=[pixels], device=device)
    return pixels.numpy()
