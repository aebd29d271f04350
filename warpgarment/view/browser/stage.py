"""The scene of a page: meshes of each side, of which only what has changed is sent."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from . import bands
from .figures import BodyDistance, apart, stretch
from .parts import Part, Side
from .turns import Turns

if TYPE_CHECKING:
    import viser

PLAIN, DISTANCE, STRAIN, ERROR = "plain", "distance to the body", "stretch against rest", "distance to the second"
SCALES = {DISTANCE: bands.DISTANCE, STRAIN: bands.STRAIN, ERROR: bands.ERROR}
ROOT = "/results"


class Look(NamedTuple):
    """How a frame is shown.

    Attributes:
        frame: Number of the frame.
        color: `PLAIN`, or a key of `SCALES`.
        wireframe: Whether edges are shown in place of faces.
        hidden: Names of parts that are not shown.
        in_place: Whether the body stays where it is in the first frame.
        version: Counts the results of runs, so that the same frame of another one is sent.
    """

    frame: int
    color: str
    wireframe: bool
    hidden: frozenset[str]
    in_place: bool
    version: int


class Stage:
    """Nodes of a viser scene, one for each part and, of garments that are coloured, one for each step of the scale.

    Args:
        server: The server whose scene it is.
        sides: What is shown.
        shift: How far the first side moves from its first frame, [T,3] [m].
        turns: Lock that is held while kernels run.

    Attributes:
        nodes: The meshes by their paths in the scene.
        looks: What is shown, or None.
    """

    def __init__(self, server: viser.ViserServer, sides: Sequence[Side], shift: np.ndarray, turns: Turns) -> None:
        self._server, self.sides, self._shift, self._turns = server, list(sides), shift, turns
        server.scene.add_frame(ROOT, show_axes=False)
        self.looks: Look | None = None
        self._shown: dict[str, tuple[Any, ...]] = {}  # of each part, what it shows
        self.nodes: dict[str, viser.MeshHandle] = {}
        for side in sides:
            server.scene.add_frame(f"{ROOT}/{side.name}", show_axes=False, position=(side.x, 0.0, 0.0))
        self._distance = [
            None if side.body is None else BodyDistance(side.body.frames, side.body.faces) for side in sides
        ]

    def figures(self) -> list[str]:
        """What garments can be coloured by: plain first."""
        found = [PLAIN]
        if any(side.body is not None for side in self.sides):
            found.append(DISTANCE)
        found.append(STRAIN)
        return [*found, ERROR] if any(_twins(self.sides)) else found

    @property
    def scale(self) -> bands.Scale | None:
        """The scale of the colours that are shown; None for plain ones."""
        return None if self.looks is None else SCALES.get(self.looks.color)

    def show(self, look: Look) -> None:
        """Sends what differs from what is shown."""
        with self._server.atomic():
            for number, side in enumerate(self.sides):
                for part in side.parts:
                    self._show_part(number, side, part, look)
        self.looks = look

    def _show_part(self, number: int, side: Side, part: Part, look: Look) -> None:
        path = f"{ROOT}/{side.name}/{part.name}"
        vertices = part.frames[look.frame]
        if part.name in look.hidden or not np.isfinite(vertices).all():
            self._keep(path, ())
            self._shown.pop(path, None)
            return
        color = PLAIN if part is side.body else look.color
        wanted = (look.frame, look.version, color, look.wireframe, look.in_place)
        if self._shown.get(path) == wanted:
            return
        self._shown[path] = wanted
        values = None if color == PLAIN else self._values(number, side, part, look, color)
        if look.in_place:  # not by moving the scene's root: a slow browser moves that before it has the positions
            vertices = vertices - self._shift[look.frame]
        if values is None:
            rgb: bands.Color = tuple(int(part.color[i : i + 2], 16) for i in (1, 3, 5))  # type: ignore[assignment]
            self._send(f"{path}/plain", vertices, part.faces, rgb, look.wireframe, flat=False)
            self._keep(path, (f"{path}/plain",))
            return
        scale, kept = SCALES[color], []
        for step, corners, faces in bands.split(vertices, part.faces, scale.steps(values)):
            kept.append(f"{path}/{color}/{step}")
            self._send(kept[-1], corners, faces, scale.colors[step], look.wireframe, flat=True)
        self._keep(path, kept)

    def _values(self, number: int, side: Side, part: Part, look: Look, color: str) -> np.ndarray | None:
        """The figure of each face; None where this part has none."""
        vertices = part.frames[look.frame]
        if color == STRAIN:
            return stretch(part.rest, vertices, part.faces)
        if color == DISTANCE:
            distance = self._distance[number]
            if distance is None:
                return None
            with self._turns:
                return distance.at(look.frame, vertices, part.faces)
        place = side.garments.index(part)
        twin = self.sides[1 - number].garments[place] if _twins(self.sides)[place : place + 1] == [True] else None
        return None if twin is None else apart(vertices, twin.frames[look.frame], part.faces)

    def _send(
        self, path: str, vertices: np.ndarray, faces: np.ndarray, color: bands.Color, wireframe: bool, flat: bool
    ) -> None:
        node = self.nodes.get(path)
        if node is None:
            add = self._server.scene.add_mesh_simple
            options: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False, "side": "double"}
            self.nodes[path] = add(
                path, vertices, faces, color=color, wireframe=wireframe, flat_shading=flat and not wireframe, **options
            )
            return
        node.vertices, node.faces = vertices, faces  # viser sends neither where it is what was sent before
        node.flat_shading, node.wireframe = flat and not wireframe, wireframe
        node.visible = True

    def _keep(self, path: str, kept: Collection[str]) -> None:
        """Hides the nodes of a part but for some."""
        for name, node in self.nodes.items():
            if name.startswith(f"{path}/") and name not in kept:
                node.visible = False


def _twins(sides: Sequence[Side]) -> list[bool]:
    """Of each garment of the first side, whether the second has the same mesh at its place."""
    if len(sides) < 2:
        return []
    return [
        len(a.rest) == len(b.rest) and np.array_equal(a.faces, b.faces)
        for a, b in zip(sides[0].garments, sides[1].garments, strict=False)
    ]
