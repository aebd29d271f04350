"""Scenes of garments and bodies that come again: training draws many samples of a sequence, in other frames each time.

A scene is taken for one batch and can be taken again once that batch is gone.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from typing import Any
from weakref import ReferenceType, ref

from warpgarment.sim.scene import Scene

MOST = 16
"""Largest number of scenes that are kept, of some 10 MB each for garments of 2,000 faces."""


class Scenes:
    """Scenes by what they are of.

    Args:
        most: Largest number of scenes.
    """

    def __init__(self, most: int = MOST) -> None:
        self.most = most
        self._kept: list[tuple[Hashable, Scene, ReferenceType[Any]]] = []
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    def take(self, key: Hashable) -> Scene | None:
        """A scene whose batch is gone, which is then no longer kept here; None if there is none.

        Args:
            key: What the scene is of: garments and bodies in their order, and their subsets of faces.
        """
        with self._lock:
            for place, (known, scene, batch) in enumerate(self._kept):
                if known == key and batch() is None:
                    del self._kept[place]
                    return scene
        return None

    def keep(self, key: Hashable, scene: Scene, batch: object) -> None:
        """Keeps the scene of a batch, and forgets the one that was used least recently beyond `most`.

        Args:
            key: As of `take`.
            scene: The scene.
            batch: The batch, of which this keeps no reference. Gradients of its losses must not be asked for after it
                is gone.
        """
        with self._lock:
            self._kept.append((key, scene, ref(batch)))
            del self._kept[: -self.most]
