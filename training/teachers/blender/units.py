"""A cloth scene in Blender's numbers.

Blender's cloth counts time in frames and has its own scale for every setting. The scales follow from the equations in
its source and were confirmed by measurements (a free fall, hanging strips, a sheet pushed by the wind), with S of
Blender's units of length per metre, f frames per second, and k the ratio of Blender's mass of a vertex to its mass in
kg:

    gravity      0.001 G per frame^2                    G = 1000 g S / f^2
    spring       T / (mean edge) per length             T = K k S (mean edge) / f^2,  K [N/m] a spring's stiffness
    its damping  D per length a frame                   D = c k / f,                  c [N s/m]
    bending      moment of a hinge 0.1 b L h / 3        b = 30 B k / (h f^2),         B [N] moment per angle and length
    air          0.02 A (s/f - F v) along the normal    see :func:`air`

L is a hinge's length, h the height of its triangles, A a face's area, and v a velocity per frame.

Blender has these limits: springs along edges make a sheet with Poisson's ratio 1/3, so there is no free shear stiffness
(Blender has one for quadrilaterals only), and only :attr:`.Material.modulus` counts; all vertices have one mass and all
cloths one friction. Stiffness is therefore multiplied by each cloth's own ratio k. Gravity, inertia, stretch and
bending of every cloth then have the proportions of its material; the common mass only affects how hard one cloth pushes
another, and how much the air moves it. Vertices of borders have twice the mass of their share of the area.

Lengths are scaled up because of constants in Blender: it drops contacts closer than 0.35 mm in its unit of length, and
treats triangles with edges below 20 mm as points when it spreads an impulse over their corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warpgarment.kernels.wind import DRAG
from warpgarment.training.teachers import Cloth, ClothScene
from warpgarment.training.teachers.scenes import bound_to_body

AIR_DENSITY = 1.225  # density of air at sea level [kg/m^3]
STIFFEST = 1000.0  # Blender's number for the stiffest cloth, at most 10,000; the mass of a vertex follows from it
STEADY = 4.0  # bending / (mass substeps^2) at which cloth stays calm: Blender's bending is explicit; at 15 it trembled
MOST_SUBSTEPS = 42


@dataclass(frozen=True)
class BlenderSettings:
    """Settings of Blender's cloth, in SI units where they have one.

    Attributes:
        substeps: Blender's quality steps per frame; stiff hinges get more, see :func:`steady_substeps`.
        collision_rounds: Number of rounds of collision response in a substep.
        scale: Blender's units of length per metre.
        compression: Stiffness against compression as a share of that against tension. Cloth wrinkles instead of being
            compressed, but on a mesh only where wrinkles are longer than its edges: at 1, a flared skirt of 40 mm edges
            stands like a bell. Below 1, springs across a pull give way: at 0.03 a strip stretches 1.1 to 2.3 times as
            far as its modulus predicts, depending on the orientation of its mesh, at 1 0.93 to 1.03 times.
        distance: Distance kept between cloth and body [m].
        self_distance: Distance kept between parts of a cloth [m]; at most a quarter of a garment's mean edge.
        layer_distance: Distance kept between cloths in a scene with several ones [m]; with less, layers go through each
            other.
        drag: Coefficient of the air's force on a face along its normal, without unit; 0 is a vacuum.
        air_speed: Speed at which Blender's air resistance, which is linear in the speed, is right, in addition to that
            of the wind [m/s].
        threads: Number of Blender's threads: 1, or 0 for all. If the system cannot limit a program to one processor,
            Blender uses all.
    """

    substeps: int = 10
    collision_rounds: int = 3
    scale: float = 10.0
    compression: float = 0.03
    distance: float = 4e-3
    self_distance: float = 4e-3
    layer_distance: float = 9e-3
    drag: float = DRAG
    air_speed: float = 1.0
    threads: int = 1

    def __post_init__(self) -> None:
        taken = steps_taken(self.substeps)
        if taken != self.substeps:
            raise ValueError(
                f"with {self.substeps} substeps a frame Blender takes {taken}, since it adds up time in float32, and "
                f"every frame lasts too long. Take {self.substeps - 2} or {self.substeps + 2}."
            )


def steps_taken(substeps: int) -> int:
    """Number of steps of 1 / substeps that Blender takes in a frame: it sums them in float32 while the sum is below 1.

    For 12 substeps it takes 13 steps: bodies and pins then overshoot in every frame, and cloth falls too fast.
    """
    if substeps < 1:
        raise ValueError(f"substeps must be at least 1, got {substeps}")
    step, time, taken = np.float32(1) / np.float32(substeps), np.float32(0), 0
    while time < np.float32(1):
        time, taken = time + step, taken + 1
    return taken


LAYERED = BlenderSettings(substeps=20, compression=0.3, distance=6e-3)
"""What data are made with. With the settings above, four of four outfits failed the gate within 52 frames: cloth that a
limb pulled tight was drawn through the body by up to 37 mm, and compressed edges counted as stretched. With these all
four stay within it for the 75 frames tried, at twice the time. A hanging strip is as long as its material says."""


def steady_substeps(hardness: float, least: int) -> int:
    """Number of substeps with which hinges do not tremble, from `least` to :data:`MOST_SUBSTEPS`.

    Hinges that are too hard even for the largest number bend more easily than their material: at 0.2 kg/m^2 and a
    bending of 0.1 N on edges below 15 mm, at 1 N below 33 mm.

    Args:
        hardness: Bending stiffness over mass, in Blender's units.
        least: Least number of substeps.
    """
    wanted = max(least, min(MOST_SUBSTEPS, int(np.ceil(np.sqrt(hardness / STEADY)))))
    return next(n for n in range(wanted, wanted + 3) if steps_taken(n) == n)


def to_z_up(vectors: np.ndarray) -> np.ndarray:
    """Turns vectors [..., 3] from Y up, as everywhere here, to Z up, as in Blender: (x, y, z) to (x, -z, y)."""
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)


def to_y_up(vectors: np.ndarray) -> np.ndarray:
    """The inverse of :func:`to_z_up`."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1)


@dataclass(frozen=True)
class _Sheet:
    """The quantities from which a cloth's numbers follow: number of edges and their mean length [m], mass of a vertex
    [kg], stiffness of springs [N/m] and of hinges [N/m]."""

    edges: int
    edge: float
    mass: float
    spring: float
    hinge: float

    @classmethod
    def of(cls, cloth: Cloth) -> _Sheet:
        """Springs K between all neighbours hold a sheet of area A with Young's modulus K (sum of L^2) / (3 A), averaged
        over directions: on equilateral triangles 2 K / sqrt(3), and borders, whose springs count fully, stiffer."""
        rest, faces, edges = cloth.garment.vertices.astype(np.float64), cloth.garment.faces, cloth.garment.edges
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        corners = rest[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        height = 2.0 * area / len(faces) / lengths.mean()
        return cls(
            edges=len(edges),
            edge=float(lengths.mean()),
            mass=cloth.material.density * area / len(rest),
            spring=3.0 * cloth.material.modulus * area / float((lengths**2).sum()),
            hinge=30.0 * cloth.material.bend / height,
        )


def blender_numbers(scene: ClothScene, settings: BlenderSettings) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Blender's numbers for a scene.

    Args:
        scene: Scene to simulate, in SI units.
        settings: Settings of the simulation.

    Returns:
        Plain values for scene.json, and arrays: `structural` and `bending`, place (0 to 1) of each vertex's stiffness
        between the least and the largest, [V]; `wind`, [frames, 5], see :func:`air`, unless in a vacuum.
    """
    s, f = settings.scale, scene.fps
    sheets = [_Sheet.of(cloth) for cloth in scene.cloths]
    materials = [cloth.material for cloth in scene.cloths]
    counts = np.array([len(cloth.garment.vertices) for cloth in scene.cloths])
    shares = counts / counts.sum()

    edge = float(np.average([sheet.edge for sheet in sheets], weights=[sheet.edges for sheet in sheets]))
    springs = np.array([sheet.spring for sheet in sheets])
    masses = np.array([sheet.mass for sheet in sheets])
    tension = springs / masses * s * edge / f**2  # over Blender's mass of a vertex, so far
    bending = np.array([sheet.hinge for sheet in sheets]) / masses / f**2
    substeps = steady_substeps(float(bending.max()), settings.substeps)
    bending = np.minimum(bending, STEADY * substeps**2)
    mass = STIFFEST / float(max(tension.max(), bending.max()))
    tension, bending, ratios = tension * mass, bending * mass, mass / masses
    damping = float(shares @ [m.damping * k * r for m, k, r in zip(materials, springs, ratios, strict=True)]) / f
    friction = min(80.0, 100.0 * float(np.mean([m.friction for m in materials])))
    apart = settings.self_distance if len(sheets) == 1 else settings.layer_distance
    apart = min(apart, *(0.25 * sheet.edge for sheet in sheets))

    numbers = {
        "threads": settings.threads,
        "fps": max(1, round(f)),
        "fps_base": max(1, round(f)) / f,
        "first_frame": 2 + scene.settle,
        "last_frame": 1 + scene.settle + len(scene),
        "gravity": (to_z_up(np.asarray(scene.gravity, dtype=np.float64)) * 1000.0 * s / f**2).tolist(),
        "cloth": {
            "quality": substeps,
            "mass": mass,
            "air_damping": 0.0,
            "tension_stiffness": tension.min(),
            "tension_stiffness_max": tension.max(),
            "compression_stiffness": settings.compression * tension.min(),
            "compression_stiffness_max": settings.compression * tension.max(),
            "bending_stiffness": bending.min(),
            "bending_stiffness_max": bending.max(),
            "tension_damping": min(50.0, damping),
            "compression_damping": min(50.0, damping),
            "bending_damping": 0.0,
        },
        "collision": {
            "use_collision": scene.body_frames is not None,
            "use_self_collision": True,
            "collision_quality": settings.collision_rounds,
            "distance_min": _half_distance(settings.distance, s),
            "self_distance_min": _half_distance(apart, s),
            "self_friction": friction,
        },
        "collider": {
            "thickness_outer": _half_distance(settings.distance, s),
            "cloth_friction": friction,
            "use_culling": True,
            "use_normal": False,
        },
    }
    arrays = {"structural": np.repeat(_weights(tension), counts), "bending": np.repeat(_weights(bending), counts)}
    if settings.drag > 0:
        arrays["wind"] = air(scene, settings, float(shares @ ratios))
    return numbers, arrays


def _half_distance(distance: float, scale: float) -> float:
    """Half of a distance [m] in Blender's units; Blender keeps the sum of two distances, each from 0.001 to 0.1."""
    return float(np.clip(0.5 * distance * scale, 1e-3, 0.1))


def _weights(values: np.ndarray) -> np.ndarray:
    """Places of values between the least and the largest of them, 0 to 1."""
    span = values.max() - values.min()
    return (values - values.min()) / span if span > 1e-9 * values.max() else np.zeros_like(values)


def air(scene: ClothScene, settings: BlenderSettings, ratio: float) -> np.ndarray:
    """Blender's wind in each of its frames, [frames, 5]: direction with Z up, strength s and air flow F.

    Drag is 1/2 rho cd A |w - v| (w - v).n along the normal n of a face; Blender has 0.02 A (s/f w/|w| - F v).n. On
    cloth at rest both are equal for s = 1/2 rho cd |w|^2 k / (0.02 S f); moving cloth is slowed by 1/2 rho cd A u v.n,
    where u is the wind's speed plus `air_speed`. Lift along the face has no counterpart.

    Args:
        scene: Scene with its wind.
        settings: Settings, of which scale, drag and air speed are read.
        ratio: Ratio k of Blender's mass of a vertex to its mass [1/kg].
    """
    s, f = settings.scale, scene.fps
    wind = np.zeros((len(scene), 3)) if scene.wind is None else np.asarray(scene.wind, dtype=np.float64)
    wind = np.concatenate([np.repeat(wind[:1], scene.settle + 1, axis=0), wind])
    speed = np.linalg.norm(wind, axis=1)
    direction = np.where(speed[:, None] > 0, wind / np.maximum(speed, 1e-12)[:, None], (1.0, 0.0, 0.0))
    unit = 0.5 * AIR_DENSITY * settings.drag * ratio / 0.02
    strength = unit * speed**2 / (s * f)
    flow = unit * (speed + settings.air_speed) / (s**2 * f)
    return np.concatenate([to_z_up(direction), strength[:, None], flow[:, None]], axis=1)


def pin_path(points: np.ndarray, body_frames: np.ndarray, body_faces: np.ndarray) -> np.ndarray:
    """Path of pinned points, which keep their place on, and height above, the face nearest to them in the first frame.

    Args:
        points: Positions in the first frame [m], shape [P, 3].
        body_frames: Body vertices in every frame [m], shape [T, U, 3].
        body_faces: Vertex indices of the body, shape [G, 3].

    Returns:
        Positions in every frame [m], shape [T, P, 3].
    """
    face, weights, height = bound_to_body(points, body_frames[0], body_faces)
    corners = body_frames[:, body_faces[face]].astype(np.float64)  # [T, P, 3, 3]
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.einsum("pk,tpkc->tpc", weights, corners) + height[:, None] * normal
