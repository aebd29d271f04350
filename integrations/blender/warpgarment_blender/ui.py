"""What is seen in Blender: preferences, the panel in the sidebar of the 3D view, and the operators of its buttons."""

from typing import Any, ClassVar

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, PointerProperty, StringProperty

from . import cache
from .scene import JobError, Reader
from .task import Task

MATERIALS = ("cotton", "denim", "jersey", "rib", "ponte", "silk", "leather")
EVERY = 0.1  # seconds between two steps


def _is_mesh(_: Any, held: Any) -> bool:
    return held.type == "MESH"


class WarpgarmentPreferences(bpy.types.AddonPreferences):
    """Where warpgarment is."""

    bl_idname = __package__

    python: StringProperty(
        name="Python",
        subtype="FILE_PATH",
        description="A Python that has warpgarment: .venv/bin/python",
    )

    def draw(self, _: Any) -> None:
        """Shows the path."""
        self.layout.prop(self, "python")


class WarpgarmentSettings(bpy.types.PropertyGroup):
    """What is simulated, kept with the scene."""

    garment: PointerProperty(name="Garment", type=bpy.types.Object, poll=_is_mesh)
    body: PointerProperty(name="Body", type=bpy.types.Object, poll=_is_mesh)
    pins: StringProperty(name="Pins", description="Vertex group of the garment that is tied to the body")
    network: StringProperty(name="Network", default="default", description="Name or path of a network")
    device: StringProperty(name="Device", description="cpu or cuda:0; empty takes a GPU if there is one")
    material: EnumProperty(
        name="Material",
        items=[("NONE", "none", "For networks that read none"), *((name, name, "") for name in MATERIALS)],
        description="Material, for networks that read it (layers)",
    )
    wind: FloatVectorProperty(name="Wind", subtype="XYZ", description="Velocity of the air [m/s], for the same")
    clean: BoolProperty(name="Join seams", description="Join open borders at the same place, repair faults")
    itself: BoolProperty(name="Self collision", description="Keep the garment from crossing itself")
    path: StringProperty(
        name="Cache", subtype="FILE_PATH", description="Where the result is written; by default beside the .blend"
    )
    share: FloatProperty(name="Progress", subtype="FACTOR", min=0.0, max=1.0, options={"SKIP_SAVE"})
    words: StringProperty(options={"SKIP_SAVE"})
    running: BoolProperty(options={"SKIP_SAVE"})
    stop: BoolProperty(options={"SKIP_SAVE"})


def chosen(context: Any) -> tuple[Any, Any]:
    """Garment and body: those of the panel, else the active object and the other one that is selected."""
    settings = context.scene.warpgarment
    garment = settings.garment or context.view_layer.objects.active
    others = [held for held in context.view_layer.objects.selected if held != garment and held.type == "MESH"]
    if settings.body is None and len(others) != 1:
        raise JobError(f"{len(others)} meshes are selected besides the garment. Select the body, or choose it.")
    return garment, settings.body or others[0]


def started(context: Any) -> Task:
    """A task of what is chosen.

    Raises:
        JobError: Something is missing.
    """
    settings = context.scene.warpgarment
    garment, body = chosen(context)
    cache.detach(garment)  # an old result is not what it starts from
    x, y, z = settings.wind
    options = {
        "name": garment.name,
        "network": settings.network,
        "device": settings.device,
        "material": "" if settings.material == "NONE" else settings.material,
        "wind": [x, z, -y],
        "clean": settings.clean,
        "itself": settings.itself,
    }
    python = bpy.path.abspath(context.preferences.addons[__package__].preferences.python)
    reader = Reader(context.scene, garment, body, settings.pins)
    return Task(python, reader, garment, cache.place_of(settings.path, garment), options)


class WARPGARMENT_OT_simulate(bpy.types.Operator):
    """Simulate the garment over the scene's frames, in a process of its own"""

    bl_idname = "warpgarment.simulate"
    bl_label = "Simulate"
    bl_options: ClassVar = {"REGISTER"}

    _task: Task | None = None
    _timer: Any = None
    _frame = 0

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Whether none runs already."""
        return not context.scene.warpgarment.running

    def _begin(self, context: Any) -> bool:
        settings = context.scene.warpgarment
        self._frame = context.scene.frame_current
        try:
            self._task = started(context)
        except JobError as error:
            settings.words = str(error)
            self.report({"ERROR"}, str(error))
            return False
        settings.running, settings.stop, settings.share, settings.words = True, False, 0.0, self._task.words
        return True

    def _step(self, context: Any) -> set[str] | None:
        """Does a little; returns how it ended, or None."""
        settings, task = context.scene.warpgarment, self._task
        assert task is not None
        try:
            if settings.stop:
                task.close()
                settings.words = "stopped"
                return self._end(context, {"CANCELLED"})
            task.step()
        except Exception as error:  # also what is no fault of the user: the operator must not stay half alive
            task.close()
            settings.words = str(error) if isinstance(error, JobError) else f"{type(error).__name__}: {error}"
            self.report({"ERROR"}, settings.words)
            return self._end(context, {"CANCELLED"})
        settings.share, settings.words = task.share, task.words
        if not task.finished:
            return None
        for text in task.warnings:
            self.report({"WARNING"}, text)
        self.report({"INFO"}, f"warpgarment: {task.words}")
        return self._end(context, {"FINISHED"})

    def _end(self, context: Any, result: set[str]) -> set[str]:
        context.scene.warpgarment.running = False
        context.scene.frame_set(self._frame)
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
        return result

    def execute(self, context: Any) -> set[str]:
        """Runs to the end, for scripts."""
        import time

        if not self._begin(context):
            return {"CANCELLED"}
        while True:
            ended = self._step(context)
            if ended:
                return ended
            time.sleep(EVERY / 10)

    def invoke(self, context: Any, _: Any) -> set[str]:
        """Begins, and goes on whenever the timer rings: Blender stays usable."""
        if not self._begin(context):
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(EVERY, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Any, event: Any) -> set[str]:
        """One step for each ring of the timer."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        ended = self._step(context)
        for area in context.screen.areas if context.screen else ():
            if area.type == "VIEW_3D":
                area.tag_redraw()
        return ended or {"PASS_THROUGH"}


class WARPGARMENT_OT_stop(bpy.types.Operator):
    """Stop the simulation that runs"""

    bl_idname = "warpgarment.stop"
    bl_label = "Stop"

    def execute(self, context: Any) -> set[str]:
        """Lets the other operator end."""
        context.scene.warpgarment.stop = True
        return {"FINISHED"}


class WARPGARMENT_OT_remove(bpy.types.Operator):
    """Take the result away, and switch the garment's own modifiers on again"""

    bl_idname = "warpgarment.remove"
    bl_label = "Remove result"

    def execute(self, context: Any) -> set[str]:
        """Removes the modifier; the file stays."""
        garment = context.scene.warpgarment.garment or context.view_layer.objects.active
        if garment is not None:
            cache.detach(garment)
        return {"FINISHED"}


class WARPGARMENT_PT_panel(bpy.types.Panel):
    """The panel."""

    bl_label = "warpgarment"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "warpgarment"

    def draw(self, context: Any) -> None:
        """Shows settings, buttons and how far it is."""
        layout, settings = self.layout, context.scene.warpgarment
        layout.use_property_split = True
        for name in ("garment", "body"):
            layout.prop(settings, name)
        if settings.garment is not None:
            layout.prop_search(settings, "pins", settings.garment, "vertex_groups")
        for name in ("network", "device", "material", "wind", "clean", "itself", "path"):
            layout.prop(settings, name)
        if settings.running:
            layout.progress(factor=settings.share, text=settings.words)
            layout.operator("warpgarment.stop")
            return
        layout.operator("warpgarment.simulate")
        layout.operator("warpgarment.remove")
        if settings.words:
            layout.label(text=settings.words)


CLASSES = (
    WarpgarmentPreferences,
    WarpgarmentSettings,
    WARPGARMENT_OT_simulate,
    WARPGARMENT_OT_stop,
    WARPGARMENT_OT_remove,
    WARPGARMENT_PT_panel,
)


def register() -> None:
    """Adds all classes, and the settings to scenes."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.warpgarment = PointerProperty(type=WarpgarmentSettings)


def unregister() -> None:
    """Takes them away again."""
    del bpy.types.Scene.warpgarment
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
