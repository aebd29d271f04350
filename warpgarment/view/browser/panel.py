"""The controls of a page: playback, what is shown, colours, and for what can be run again, wind and materials."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind

from .bands import Scale
from .parts import BODY, Side
from .reruns import Live, Run, Settings
from .stage import PLAIN, Look

if TYPE_CHECKING:
    import viser

PLAY, HOLD = "Play", "Pause"
GIVEN = "as given"
FASTEST = 20.0  # wind of the slider [m/s]
Post = Callable[[Callable[[], None]], None]


class Panel:
    """Playback and looks.

    Args:
        server: The server whose panel it is.
        sides: What is shown.
        figures: What garments can be coloured by.
        frames: Number of frames.
        post: Function that has something done by the thread of the page, and shows what comes of it.

    Attributes:
        scrubbed: Called with a frame when somebody moves the slider.
        pressed: Called when somebody presses the button that plays and holds.
    """

    def __init__(
        self, server: viser.ViserServer, sides: Sequence[Side], figures: Sequence[str], frames: int, post: Post
    ) -> None:
        self.scrubbed: Callable[[int], None] = lambda frame: None
        self.pressed: Callable[[], None] = lambda: None
        gui: Any = server.gui  # viser's annotations make values read-only, which they are not
        self.play = gui.add_button(PLAY)
        self.frame = gui.add_slider("frame", 0, max(frames - 1, 1), 1, 0, disabled=frames < 2)
        self.speed = gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0)
        self.time = gui.add_markdown("")
        names = list(dict.fromkeys(part.name for side in sides for part in side.garments))
        names += [BODY] if any(side.body is not None for side in sides) else []
        with gui.add_folder("Show"):
            self.shown = {name: gui.add_checkbox(name, True) for name in names}
            self.wireframe = gui.add_checkbox("wireframe", False)
            self.in_place = gui.add_checkbox("stay in place", False, hint="Takes the way of the body away.")
        with gui.add_folder("Color"):
            self.color = gui.add_dropdown("by", tuple(figures), initial_value=PLAIN)
            self.legend = gui.add_html("")
        self.play.on_click(lambda _: post(self.pressed))
        self.frame.on_update(lambda event: self._moved(event, post))
        for handle in (self.speed, *self.shown.values(), self.wireframe, self.in_place, self.color):
            handle.on_update(lambda _: post(lambda: None))

    def _moved(self, event: Any, post: Post) -> None:
        if event.client is not None:  # not by the page itself
            post(lambda: self.scrubbed(int(self.frame.value)))

    def look(self, frame: int, version: int) -> Look:
        """What the controls say, for a frame."""
        hidden = frozenset(name for name, box in self.shown.items() if not box.value)
        color, wireframe, in_place = self.color.value, bool(self.wireframe.value), bool(self.in_place.value)
        return Look(frame, color, wireframe, hidden, in_place, version)

    def tell_color(self, scale: Scale | None) -> None:
        """Shows the scale of the colours, or none."""
        content = "" if scale is None else legend(scale)
        if self.legend.content != content:
            self.legend.content = content

    def tell_frame(self, frame: int, words: str, playing: bool) -> None:
        """Shows where playback is; `words` are about the frame."""
        self.frame.value = frame
        self.time.content = words
        label = HOLD if playing else PLAY
        if self.play.label != label:
            self.play.label = label


def legend(scale: Scale) -> str:
    """The steps of a scale as HTML."""
    rows = "".join(
        f'<div style="display:flex;align-items:center;gap:.5em"><span style="width:1.4em;height:.9em;'
        f'background:rgb{color}"></span>{html.escape(label)}</div>'
        for label, color in zip(scale.labels, scale.colors, strict=True)
    )
    return f'<div style="font-size:.8em;padding:0 1em .5em">{html.escape(scale.title)}{rows}</div>'


class LivePanel:
    """Wind and materials.

    Args:
        server: The server whose panel it is.
        live: What is run again.
        changed: Called with the new settings when somebody changes one.
    """

    def __init__(self, server: viser.ViserServer, live: Live, changed: Callable[[Settings], None]) -> None:
        gui: Any = server.gui
        self._live, self._changed = live, changed
        self._steady = live.wind is None  # whether the wind is that of the sliders
        speed, angle = _as_sliders(live.wind)
        self.speed = self.angle = None
        if "wind" in live.reads:
            with gui.add_folder("Wind"):
                self.speed = gui.add_slider("speed [m/s]", 0.0, FASTEST, 0.5, speed)
                self.angle = gui.add_slider(
                    "blows from [°]", -180.0, 180.0, 5.0, angle, hint="0 is the front (+Z), 90 is +X"
                )
            for slider in (self.speed, self.angle):
                slider.on_update(self._blown)
        self.materials: list[Any] = []
        if "materials" in live.reads:
            with gui.add_folder("Material"):
                for garment in live.garments:
                    options = (GIVEN, *Material.presets())
                    self.materials.append(gui.add_dropdown(garment.name or "garment", options, initial_value=GIVEN))
            for dropdown in self.materials:
                dropdown.on_update(lambda _: self._changed(self.settings))
        with gui.add_folder("Simulation"):
            self.progress = gui.add_progress_bar(0.0)
            self.words = gui.add_markdown("")

    def _blown(self, _: Any) -> None:
        self._steady = True
        self._changed(self.settings)

    @property
    def settings(self) -> Settings:
        """What the controls say."""
        wind = self._live.wind
        if self.speed is not None and self.angle is not None and self._steady:
            speed, angle = float(self.speed.value), math.radians(float(self.angle.value))
            wind = Wind([-math.sin(angle), 0.0, -math.cos(angle)], speed) if speed else None
        materials = list(self._live.materials)
        for k, dropdown in enumerate(self.materials):
            if dropdown.value != GIVEN:
                materials[k] = Material.preset(dropdown.value)
        return Settings(tuple(materials), wind)

    def tell(self, run: Run) -> None:
        """Shows how far a run is."""
        count = len(run.frames[0])
        self.progress.value = 100.0 * run.ready / count
        each = 1e3 * run.seconds / max(run.ready - 1, 1)
        words = f"{run.ready} of {count} frames, {each:.0f} ms a frame"
        if run.left is not None:
            words += f", {run.left:.0f} s left"
        if run.fault:
            words = f"**{run.fault}**"
        self.words.content = words


def _as_sliders(wind: Wind | None) -> tuple[float, float]:
    """Speed and direction of a wind's first row, as the sliders have them."""
    if wind is None:
        return 0.0, 0.0
    x, y, z = wind.rows[0].tolist()
    speed = min(math.sqrt(x * x + y * y + z * z), FASTEST)
    return round(2 * speed) / 2, 5.0 * round(math.degrees(math.atan2(-x, -z)) / 5.0)
