"""A frame as one CUDA graph: the network's kernels and Warp's, recorded once and replayed with one call.

A frame of a small garment is some hundred launches of a few microseconds each, which cost the host more than the GPU.
Nothing in a frame waits for the device, and a scene's shapes never change, so the whole frame can be recorded. A graph
reads and writes fixed memory: inputs are copied in and results out, so that states stay values.

    frame, frame, frame       run as they are: modules are loaded, workspaces made, the allocators warm
    record, replay, replay    from then on

A recording that fails says why in a RuntimeWarning, and frames go on as before it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from .advance import advance
from .frame import Frame
from .scene import Scene

WARM_UP = 3  # frames

Record = Callable[[Callable[[], Frame]], tuple[Frame, Callable[[], None]]]


def cuda_graph(run: Callable[[], Frame]) -> tuple[Frame, Callable[[], None]]:
    """Records a call as a CUDA graph without running it.

    Warp launches on torch's current stream (`kernels/launch.py`), which is the stream being captured; Warp is told of
    the capture so that it keeps the modules of its kernels.

    Returns:
        The tensors that a replay fills in, and the replay.
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
    """Runs `advance` for the frames of one scene, first as it is and then as replays.

    Args:
        scene: The scene, whose bodies a frame moves.
        record: Makes a recording, as `cuda_graph`.
    """

    def __init__(self, scene: Scene, record: Record = cuda_graph) -> None:
        self.scene, self.record = scene, record
        self.seen = 0
        self.failed = False
        self._recorded: tuple[Frame, torch.Tensor, Frame, Callable[[], None]] | None = None

    def __call__(self, now: Frame, next_body: torch.Tensor) -> Frame:
        """One frame on; the result is the caller's."""
        if self._recorded is None:
            self.seen += 1
            if self.failed or self.seen <= WARM_UP or not self._record(now, next_body):
                return advance(self.scene, now, next_body)
        assert self._recorded is not None
        before, body, after, replay = self._recorded
        self.scene.bodies.at(now.body)
        for held, given in zip((*before, body), (*now, next_body), strict=True):
            held.copy_(given)
        replay()
        self.scene.bodies.placed = next_body  # the graph has moved the bodies' search trees there
        return type(now)(*(tensor.clone() for tensor in after))._replace(body=next_body)

    @property
    def recorded(self) -> bool:
        """Whether frames are replayed from now on."""
        return self._recorded is not None

    def _record(self, now: Frame, next_body: torch.Tensor) -> bool:
        before, body = type(now)(*(tensor.clone() for tensor in now)), next_body.clone()
        self.scene.bodies.at(now.body)
        self.scene.bodies.placed = before.body  # where a replay finds them
        try:
            with torch.cuda.device_of(now.positions):  # nothing where that is no GPU
                after, replay = self.record(lambda: advance(self.scene, before, body))
        except Exception as error:  # whatever CUDA, torch or Warp refuse to capture
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
