"""A page that shows garments in motion in a web browser: `browse` serves it (extra `browser`, viser)."""

from __future__ import annotations

import contextlib
import io
import math
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.errors import MissingExtra, UsageError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import Clock
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view import draw
from warpgarment.view.matched import Motion, matched

from .address import free_port, reached
from .panel import LivePanel, Panel
from .parts import Side, centres, place, side_of
from .playhead import Playhead
from .reruns import Live, Reruns, Settings
from .stage import Stage
from .turns import Turns

if TYPE_CHECKING:
    import viser

FAR = 0.75  # metres: a body that goes farther is kept in place at first
SHARE = 0.1  # seconds between two updates of the slider while it plays
TITLE = "warpgarment"


def browse(
    garments: GarmentMotion | Sequence[GarmentMotion] | Live,
    body: BodyMotion | None = None,
    *,
    beside: GarmentMotion | Sequence[GarmentMotion] = (),
    rest: Sequence[Any] = (),
    host: str = "127.0.0.1",
    port: int | None = None,
) -> Browser:
    """Serves a page on which garments in motion can be looked at from all sides.

        with wg.browse(motion, body) as page:
            print(page.url)
            page.wait()

    The page plays, scrubs, and colours garments by distance to the body, stretch, or distance to a second result. What
    can be run again (`wg.Rerun`) has sliders for the wind and menus for materials, as far as its network reads them.
    Frames are sent when they are shown, and of them what differs from the frame before.

    Args:
        garments: Garment motions, innermost first; or what can be run again.
        body: The body, or None; of what can be run again, a body to show in place of the one that it collides with.
        beside: Motions of a second result, shown to the right, with the same body.
        rest: Positions of each garment at rest [m], [V,3], for stretch; None, or none: those of the first frame.
        host: Address at which the page is served. The default is for this machine alone; "0.0.0.0" lets everybody on
            the network look, and move the sliders.
        port: Port at which the page is served; None for 8080, or the next one that is free; 0 for any free one.

    Returns:
        The page, which is served until it is closed.

    Raises:
        UsageError: There is no garment, motions have no frame in common, or the host or port cannot be had.
        MissingExtra: viser is not installed (``pip install "warpgarment[browser]"``).
    """
    if isinstance(garments, GarmentMotion):
        garments = [garments]
    second = [beside] if isinstance(beside, GarmentMotion) else list(beside)
    live: Live | None = None
    if isinstance(garments, Sequence):
        first = list(garments)
        if not first:
            raise UsageError("browse was given no garment. Give at least one motion.")
    else:
        live = garments
        first, body, rest = _waiting(live), (body or live.body), [garment.vertices for garment in live.garments]
    motions: list[Motion] = [*first, *second, *([body] if body is not None else [])]
    shown: list[Any] = list(matched(motions, [getattr(motion, "name", "") or "body" for motion in motions]))
    seen_body = shown.pop() if body is not None else None
    known: list[Any] = [*rest, *[None] * (len(first) - len(rest))]
    for motion, positions in zip(first, known, strict=True):
        if positions is not None and np.shape(positions) != motion.vertices.shape[1:]:
            raise UsageError(
                f"{motion.name or 'a garment'} has {motion.vertices.shape[1]:,} vertices, at rest {len(positions):,}. "
                "Give the mesh that it was simulated from."
            )
    sides = [side_of("first", shown[: len(first)], seen_body, known)]
    if second:
        twins = [*known, *[None] * len(second)][: len(second)]
        fitting = [
            r if r is not None and len(r) == m.vertices.shape[1] else None for r, m in zip(twins, second, strict=True)
        ]
        sides.append(side_of("second", shown[len(first) :], seen_body, fitting))
    place(sides)
    return Browser(sides, shown[0].clock, live, host, free_port(host, port))


def _waiting(live: Live) -> list[GarmentMotion]:
    """Motions of what is run, before it is: every frame as it is at rest."""
    clock = live.body.clock
    return [
        GarmentMotion(garment.vertices[None], garment.faces, clock.fps, name=garment.name).on_clock(clock)
        for garment in live.garments
    ]


class Browser:
    """A page that is being served; `browse` makes it.

    Attributes:
        url: Where it is.
        server: viser's server, for additions to the scene.
        stage: The meshes.
        panel: The controls.
        live: Controls of what can be run again, or None.
        reruns: What runs it, or None.
        playhead: Where playback is; it belongs to the page's own thread.
    """

    def __init__(self, sides: list[Side], clock: Clock, live: Live | None, host: str, port: int) -> None:
        try:
            import viser
        except ModuleNotFoundError as error:
            raise MissingExtra("browser", "A page in the browser") from error
        self._clock, self._turns = clock, Turns()
        self._posted: deque[Callable[[], None]] = deque()
        self._wake, self._closing = threading.Event(), threading.Event()
        self._told, self._version = -math.inf, 0
        self.playhead = Playhead(clock.frames, clock.fps)
        with contextlib.redirect_stdout(io.StringIO()):  # viser frames its URL, which is told once here
            self.server = viser.ViserServer(host=host, port=port, label=TITLE, verbose=False)
        self.url = f"http://{reached(host)}:{self.server.get_port()}"
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="medium")
        self.server.gui.main_panel.dock_right()  # beside the scene, not over it
        self._arrange(self.server, sides)
        shift = centres(sides[0])
        self.stage = Stage(self.server, sides, shift, self._turns)
        self.panel = Panel(self.server, sides, self.stage.figures(), clock.frames, self._post)
        self.panel.in_place.value = bool(np.linalg.norm(shift, axis=1).max() > FAR)
        self.panel.scrubbed, self.panel.pressed = self._scrubbed, self._pressed
        self.live: LivePanel | None = None
        self.reruns: Reruns | None = None
        if live is not None:
            self.reruns = Reruns(live, self._wake.set, self._turns)
            self.live = LivePanel(self.server, live, self.reruns.ask)
            self.reruns.ask(self.live.settings)
            self.playhead.play(time.monotonic())
        self.server.on_client_connect(lambda _: self._wake.set())
        self._thread = threading.Thread(target=self._loop, name="warpgarment-page", daemon=True)
        self._thread.start()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self) -> None:
        """Returns when the page is closed from another thread, or raises KeyboardInterrupt when the user stops it."""
        while not self._closing.wait(0.5):
            pass

    def close(self) -> None:
        """Ends the page: runs are given up after the frame that they are at, and the port is free again."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._wake.set()
        if self.reruns is not None:
            self.reruns.close()
        self._thread.join(30.0)
        self.server.stop()

    def _arrange(self, server: viser.ViserServer, sides: list[Side]) -> None:
        """Y up, a floor, and a camera that sees the first frame."""
        points = np.concatenate(
            [part.frames[0] + np.array([side.x, 0, 0], np.float32) for side in sides for part in side.parts]
        )
        points = points[np.isfinite(points).all(axis=1)]
        camera = draw.Camera.framing(points, size=(800, 800)) if len(points) else draw.Camera((0.0, 1.0, 0.0), 4.0)
        server.scene.set_up_direction("+y")
        server.scene.configure_environment_map(None)  # colours as they are, and quick without a graphics card
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.add_light_ambient("/light", intensity=1.2)
        floor = float(points[:, 1].min()) if len(points) else 0.0
        server.scene.add_grid("/floor", plane="xz", position=(0.0, floor, 0.0), width=10.0, height=10.0)
        eye = np.asarray(camera.target) + camera.distance * camera.direction
        server.initial_camera.position = eye
        server.initial_camera.look_at = camera.target
        server.initial_camera.fov = math.radians(camera.field_of_view)

    def _post(self, act: Callable[[], None]) -> None:
        self._posted.append(act)
        self._wake.set()

    def _pressed(self) -> None:
        now = time.monotonic()
        (self.playhead.hold if self.playhead.playing else self.playhead.play)(now)

    def _scrubbed(self, frame: int) -> None:
        now = time.monotonic()
        self.playhead.hold(now)
        self.playhead.seek(frame, now)

    def _loop(self) -> None:
        """Shows what is to be seen, whenever that changes, until the page is closed."""
        while not self._closing.is_set():
            self._wake.wait(self.playhead.wait(time.monotonic()))
            self._wake.clear()
            try:
                while self._posted:
                    self._posted.popleft()()
                if not self._closing.is_set():
                    self._show()
            except Exception as error:  # told where the server runs and on the page, which goes on
                self.playhead.hold(time.monotonic())
                traceback.print_exception(error, file=sys.stderr)
                self.panel.time.content = f"**{type(error).__name__}: {error}**"

    def _show(self) -> None:
        now = time.monotonic()
        if not self.server.get_clients():
            return
        ready = self._arrivals(now)
        if ready == 0:
            return
        self.playhead.turn(float(self.panel.speed.value), now)
        frame = self.playhead.at(now, ready)
        look = self.panel.look(frame, self._version)
        if look != self.stage.looks:
            self.stage.show(look)
            self.panel.tell_color(self.stage.scale)
        if not self.playhead.playing or now - self._told >= SHARE:
            self._told = now
            number, seconds = self._clock.number + frame, self._clock.start + frame / self._clock.fps
            self.panel.tell_frame(frame, f"frame {number:.8g}, {seconds:.2f} s", self.playhead.playing)

    def _arrivals(self, now: float) -> int | None:
        """Takes what a run has brought; returns how many frames there are, or None for all."""
        run = self.reruns.run if self.reruns is not None else None
        if self.reruns is None or self.live is None:
            return None
        if run is None:
            return 0
        garments = self.stage.sides[0].garments
        if run.ready and garments[0].frames is not run.frames[0]:  # another run: from its beginning
            for part, frames in zip(garments, run.frames, strict=True):
                part.frames = frames
            self._version += 1
            if self.playhead.playing:
                self.playhead.seek(0, now)
        if now - self._told >= SHARE or run.done:
            self.live.tell(run)
        return None if run.ready == len(run.frames[0]) else run.ready

    def ask(self, settings: Settings) -> None:
        """Runs again with other wind and materials; see `wg.Rerun`.

        Raises:
            UsageError: The page shows what cannot be run again.
        """
        if self.reruns is None:
            raise UsageError("this page shows motions that cannot be run again. Give browse a wg.Rerun.")
        self.reruns.ask(settings)
