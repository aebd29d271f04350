"""warpgarment in Blender: moves the selected garment with the selected body, and shows the result as a mesh cache.

Blender's own Python needs nothing of warpgarment: the simulation runs in a subprocess with the Python that the add-on's
preferences name. See docs/blender.md.
"""

from __future__ import annotations

bl_info = {
    "name": "warpgarment",
    "author": "warpgarment",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "3D View > Sidebar > warpgarment",
    "description": "Neural garment dynamics: moves a garment with a body",
    "category": "Physics",
}


def register() -> None:
    """Adds panel, operators and preferences; called by Blender."""
    from . import ui

    ui.register()


def unregister() -> None:
    """Takes them away again; called by Blender."""
    from . import ui

    ui.unregister()
