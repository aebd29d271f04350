"""A frame as one CUDA graph: the kernels of the network and of Warp, recorded once and replayed with one call.

A frame of a small garment is some hundred launches of a few microseconds each, which take the host longer than the GPU.
Nothing in a frame waits for the device, and the shapes of a scene never change, so the whole frame can be recorded. A
graph reads and writes fixed memory. Inputs are copied in and results out, so that states stay values.

    frame, frame, frame       without a graph, to load modules, make workspaces and warm the allocators
    record, replay, replay    all later frames

If a recording fails, a RuntimeWarning gives the reason, and frames run without a graph.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from .advance import advance
from .frame import Frame
from .history import Stacks
from .scene import Scene

WARM_UP = 3  # frames

Record = Callable[[Callable[[], Frame]], tuple[Frame, Callable[[], None]]]


def cuda_graph(run: Callable[[], Frame]) -> tuple[Frame, Callable[[], None]]:
    """Records a call as a CUDA graph without running it.

    Warp launches on torch's current stream (`kernels/launch.py`), which is the stream being captured. The capture is
    also registered with Warp, which then keeps the modules of its kernels.

    Returns:
        The tensors that a replay fills, and a function that replays the graph.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=torch.cuda.Stream(), capture_error_mode="thread_local"):
        stream = wp.stream_from_torch(torch.cuda.current_stream())
        with wp.ScopedCapture(stream=stream, external=True) as capture:
            after = run()

    def replay(_kernels: Any = capture) -> None:
        graph.replay()

    return after, replay


class GraphedFrames:
    """Runs `advance` for the frames of one scene: the first ones directly, all others by replaying a graph.

    Args:
        scene: The scene; a frame moves its bodies.
        record: Function that records a call, such as `cuda_graph`.
    """

    def __init__(self, scene: Scene, record: Record = cuda_graph) -> None:
        self.scene, self.record = scene, record
        scene.stacks = Stacks()  # histories of one tensor, which are copied
        self.seen = 0
        self.failed = False
        self._recorded: tuple[Frame, torch.Tensor, Frame, Callable[[], None]] | None = None

    def __call__(self, now: Frame, next_body: torch.Tensor) -> Frame:
        """Computes the next frame, in memory that no later frame changes."""
        if self._recorded is None:
            self.seen += 1
            if self.failed or self.seen <= WARM_UP or not self._record(now, next_body):
                return advance(self.scene, now, next_body)
        assert self._recorded is not None
        before, body, after, replay = self._recorded
        self.scene.bodies.at(now.body)
        for held, given in zip((*_tensors(before), body), (*_tensors(now), next_body), strict=True):
            held.copy_(given)
        replay()
        self.scene.bodies.placed = next_body  # the graph has moved the bodies' search trees there
        return Frame(*(tensor.clone() for tensor in _tensors(after)))._replace(body=next_body)

    @property
    def recorded(self) -> bool:
        """Whether the graph has been recorded, so that frames are replayed."""
        return self._recorded is not None

    def _record(self, now: Frame, next_body: torch.Tensor) -> bool:
        before, body = Frame(*(tensor.clone() for tensor in _tensors(now))), next_body.clone()
        self.scene.bodies.at(now.body)
        self.scene.bodies.placed = before.body  # the trees before each replay
        try:
            with torch.cuda.device_of(now.positions):  # does nothing on a CPU
                after, replay = self.record(lambda: advance(self.scene, before, body))
        except Exception as error:  # anything that CUDA, torch or Warp cannot capture
            self.failed = True
            reason = str(error).strip().splitlines() or [""]
            warnings.warn(
                f"frames are not replayed as a CUDA graph, which would be faster: {type(error).__name__}: {reason[0]}. "
                "Simulator(..., graph=False) does not try",
                RuntimeWarning,
                stacklevel=5,
            )
            return False
        finally:
            self.scene.bodies.placed = None
        self._recorded = before, body, after, replay
        return True


def _tensors(frame: Frame) -> list[torch.Tensor]:
    """The fields of a frame; its history is one tensor."""
    return [field for field in frame if isinstance(field, torch.Tensor)]
