"""Physics teachers behind one interface: a cloth scene in, garment frames out.

    teacher = make_teacher("newton", device="cpu")
    for vertices in teacher.simulate(scene):   # float32 [V,3], the scene's cloths end to end
        ...

`newton` (Newton's VBD, extra `physics`) runs in this process; `blender` runs Blender's cloth through `bpy` in a virtual
environment of its own, as a subprocess; `warp` is this project's own solver (`warpgarment.kernels.physics`).
`TEACHERS` names the module of each, which is imported when it is used.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material


class TeacherEntry(NamedTuple):
    """Facts about a teacher that are known without an import of it.

    Attributes:
        module: Module with a function `make(device: str | None) -> Teacher`; None is Warp's default device.
        extra: Extra of this package that installs its requirements; None if it needs none.
        packages: Packages of this environment on whose versions its results depend.
        credit: Name and licence of the solver, to follow the words "simulated with".
    """

    module: str
    extra: str | None
    packages: tuple[str, ...]
    credit: str


# The command line's choices are written out in `GenerateConfig.teacher`. docs/extending.md adds one.
TEACHERS: dict[str, TeacherEntry] = {
    "newton": TeacherEntry(
        "warpgarment.training.teachers.newton.teacher", "physics", ("newton", "warp-lang"), "Newton (Apache-2.0)"
    ),
    "blender": TeacherEntry("warpgarment.training.teachers.blender.teacher", None, (), "Blender (GPL; not its output)"),
    "warp": TeacherEntry(
        "warpgarment.training.teachers.warp.teacher", None, ("warp-lang",), "warpgarment (Apache-2.0)"
    ),
}


@dataclass(frozen=True)
class Cloth:
    """One garment of a scene.

    Attributes:
        garment: Rest mesh [m]; its pins are tied to the body's surface, or held in place without a body.
        start: Positions at the start [m], float32 [V, 3], clear of the body's first frame and of the other cloths.
            None takes the rest mesh.
        edge: Typical edge length [m].
        material: Material of the cloth.
        velocity: Velocities at the start [m/s], float32 [V, 3]: the scene goes on from there, and its first frame is
            the start. None: the cloth is at rest, and settles first.
    """

    garment: Garment
    edge: float
    start: np.ndarray | None = None
    material: Material = field(default_factory=Material)
    velocity: np.ndarray | None = None

    @property
    def first(self) -> np.ndarray:
        """The vertices at the start, float32 [V, 3]."""
        return self.garment.vertices if self.start is None else self.start


@dataclass(frozen=True)
class ClothScene:
    """Garments on a moving body, in the wind.

    Attributes:
        cloths: Garments, innermost first.
        body_frames: Body vertices [m], float32 [T, U, 3], Y up; None for no body.
        body_faces: Faces with which cloth collides, int32 [G, 3]; they need not use every vertex.
        frames: Number of frames T without a body.
        fps: Frames per second.
        wind: Velocity of the air in each frame [m/s], [T, 3]; None for still air.
        settle: Number of frames simulated in the first pose before the first frame that is returned; 0 for a scene that
            goes on.
        gravity: Acceleration [m/s^2].
    """

    cloths: tuple[Cloth, ...]
    body_frames: np.ndarray | None = None
    body_faces: np.ndarray | None = None
    frames: int = 0
    fps: float = 30.0
    wind: np.ndarray | None = None
    settle: int = 15
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)

    def __len__(self) -> int:
        return self.frames if self.body_frames is None else len(self.body_frames)

    @property
    def goes_on(self) -> bool:
        """Whether its cloths start with given velocities."""
        return any(cloth.velocity is not None for cloth in self.cloths)

    @property
    def starts(self) -> np.ndarray:
        """First vertex of each cloth, and the number of all vertices: int [K + 1]."""
        return np.concatenate([[0], np.cumsum([len(c.garment.vertices) for c in self.cloths])])


class Moving(NamedTuple):
    """A frame of a scene.

    Attributes:
        vertices: Positions [m], float32 [V, 3], cloths end to end.
        velocities: Velocities at the end of the frame [m/s], float32 [V, 3], as the solver would go on with them.
    """

    vertices: np.ndarray
    velocities: np.ndarray


class Teacher(Protocol):
    """Simulates cloth."""

    name: str

    def simulate(self, scene: ClothScene) -> Iterator[np.ndarray]:
        """Yields T frames [m], float32 [V, 3], cloths end to end; the first is the settled drape, or the start of a
        scene that goes on.

        A caller may leave the loop early; the teacher then releases its resources.

        Raises:
            TeacherError: The simulation could not run; the message says why and what to do.
        """
        ...

    def simulate_many(self, scenes: list[ClothScene]) -> Iterator[list[np.ndarray | None]]:
        """Simulates several separate scenes at once; yields a list of one array per scene, None after its end."""
        ...

    def settings(self) -> dict[str, Any]:
        """Settings and versions on which the result depends besides the scene, as plain values for a manifest."""
        ...


@runtime_checkable
class MovingTeacher(Protocol):
    """What a teacher has in addition if it knows velocities. Newton and Warp do; Blender's keeps them to itself."""

    def simulate_moving(self, scenes: list[ClothScene]) -> Iterator[list[Moving | None]]:
        """As `Teacher.simulate_many`, with the same positions, and the velocities at the end of each frame."""
        ...


class TeacherError(RuntimeError):
    """A physics teacher could not run, or failed during a simulation."""


def make_teacher(name: str, device: str | None = "cpu") -> Teacher:
    """A teacher by name.

    Args:
        name: A key of `TEACHERS`.
        device: Warp device, such as "cpu" or "cuda:0", of teachers that run in this process; None for Warp's default.

    Raises:
        ValueError: The name is not in `TEACHERS`.
        MissingExtra: The extra of the teacher is not installed.
        TeacherError: Blender's environment has not been made.
    """
    if name not in TEACHERS:
        raise ValueError(f"unknown teacher {name!r}; there are {', '.join(TEACHERS)}")
    return importlib.import_module(TEACHERS[name].module).make(device)
