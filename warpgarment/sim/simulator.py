"""The simulator: garments on moving bodies, frame by frame (Algorithm 1).

`rollout` takes whole motions, `start` and `step` take bodies as they come; both run the same code on a packed batch,
and one garment is a batch of one.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
import torch

from warpgarment.errors import MeshError, UsageError
from warpgarment.kernels.collision.body_contacts import BodyContacts
from warpgarment.kernels.collision.contact_set import ContactSource
from warpgarment.nn import checkpoint
from warpgarment.nn.device import device_of
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.run import evaluating
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.pack import PackedBodies
from warpgarment.objects.status import RolloutStatus
from warpgarment.sim.stages.correct import Corrector

from .advance import advance
from .arguments import as_array, counted, known_frames, listed, per_garment
from .frame import Frame
from .graph import GraphedFrames
from .history import History
from .recording import READ_EVERY, Recording
from .scene import Scene
from .state import SimulationState, Status, Vertices
from .timing import Timings


class Simulator:
    """Moves garments with a network.

    Args:
        network: Moved to the device, and used in evaluation mode whatever mode it is in.
        device: "cpu", "cuda", ...; None takes CUDA where there is any.
        epsilon: Distance that collision refinement keeps between vertices and body [m]. None: 4 mm, or a fifth of a
            garment's mean edge length if that is more, since a body shows through between the vertices of coarse cloth.
        collision_passes: Collision refinement is repeated while anything of a garment is more than 0.1 mm deep, at most
            so often per frame; 0 leaves it out.
        half: Run the transformer in bfloat16: faster on recent GPUs. Geometry stays in float32.
        graph: Replay frames as one CUDA graph, after the first few (`graph.py`). None: on CUDA, and a graph that
            cannot be made is a RuntimeWarning. Off while `timings.synchronise` is set, which measures inside a frame.

    Attributes:
        timings: Seconds per stage since the simulator was made: a dict, plus `synchronise`, which must be set for it to
            be filled on CUDA.
        contact_sources: What finds contacts in the simulations that are started from now on: a list, at first
            `[BodyContacts()]`.
        correctors: What changes positions after contact, in order: a list, empty at first.
    """

    def __init__(
        self,
        network: GarmentNetwork,
        device: torch.device | str | None = None,
        *,
        epsilon: float | None = None,
        collision_passes: int = 4,
        half: bool = False,
        graph: bool | None = None,
    ) -> None:
        self.device = device_of(device)
        if (epsilon is not None and not epsilon >= 0.0) or collision_passes < 0:
            raise ValueError(f"epsilon and collision_passes must not be negative, got {epsilon} and {collision_passes}")
        if graph and self.device.type != "cuda":
            raise ValueError(f"graph=True needs a CUDA device, this is {self.device}; leave it out")
        self.graph = self.device.type == "cuda" if graph is None else graph
        self.network = network.to(self.device)
        self.epsilon, self.collision_passes, self.half = epsilon, int(collision_passes), half
        self.timings = Timings(self.device)
        self.contact_sources: list[ContactSource] = [BodyContacts()]
        self.correctors: list[Corrector] = []

    @classmethod
    def from_pretrained(
        cls, name: str | os.PathLike[str] = "default", device: torch.device | str | None = None, **options: Any
    ) -> Simulator:
        """A simulator with a trained network.

        Args:
            name: "default" (which depends on the device), the name of a network that ships, a checkpoint file, a folder
                that holds one, or a Hugging Face repository `owner/name[@revision]` (extra `hub`).
            device: As in the constructor, and so are the options.

        Raises:
            CheckpointError, MissingExtra: There is no such network, it is damaged, or cannot be fetched.
        """
        return cls(checkpoint.load(checkpoint.find(name, device=device)), device, **options)

    @overload
    def rollout(
        self,
        garment: Garment,
        body: BodyMotion | Sequence[BodyMotion],
        *,
        first_vertices: Any = None,
        history: Any = None,
        frames: int | None = None,
        face_splits: int = 1,
        progress: bool = False,
    ) -> GarmentMotion: ...

    @overload
    def rollout(
        self,
        garment: Sequence[Garment],
        body: BodyMotion | Sequence[BodyMotion],
        *,
        first_vertices: Any = None,
        history: Any = None,
        frames: int | None = None,
        face_splits: int = 1,
        progress: bool = False,
    ) -> list[GarmentMotion]: ...

    def rollout(
        self,
        garment: Garment | Sequence[Garment],
        body: BodyMotion | Sequence[BodyMotion],
        *,
        first_vertices: Any = None,
        history: Any = None,
        frames: int | None = None,
        face_splits: int = 1,
        progress: bool = False,
    ) -> GarmentMotion | list[GarmentMotion]:
        """Simulates garments over motions of their bodies, as one batch.

        Frame 0 is the garment as given: draped on the body's first frame, at rest. Bodies are resampled to the
        network's rate. Garments whose motion is shorter stop earlier; one that stops being finite ends with that frame,
        which holds NaN, with a status that says so and a RuntimeWarning.

        On a CPU the result is repeated bit for bit, and is that of each garment alone if it has more than 512 faces.
        It may depend on the number of threads in the last bit, which can grow to a millimetre: docs/rounding.md.

        Args:
            garment: One or a list.
            body: One, on which all garments are, or a list with one for each garment (which may repeat).
            first_vertices: Positions in the first frame [m], shape [V,3] (or a list), where they differ from the rest
                positions `garment.vertices`: see `wg.fit`.
            history: Known first frames, shape [H,V,3] (or a list) with H the network's `history`, of the body's first H
                frames. They are returned as they are, and the simulation goes on from them.
            frames: Stop after so many frames, known ones included.
            face_splits: Show the network so many interleaved subsets of the faces, one at a time: less time and memory.
            progress: Show a progress bar.

        Returns:
            A `GarmentMotion` at the network's rate, or a list of them for a list of garments.

        Raises:
            ValueError: Lists of different lengths, arrays of other shapes, both `first_vertices` and `history`.
            MeshError: A garment is more than 1 m from its body, or positions are not finite.
            NotEnoughMemory: The batch would not fit on the device; names the setting with which it would.
        """
        garments, single = listed(garment, Garment)
        bodies = per_garment(body, BodyMotion, len(garments), "bodies")
        unique = list({id(b): b for b in bodies}.values())
        number = {id(b): i for i, b in enumerate(unique)}
        if frames is not None and frames < 1:
            raise UsageError(f"frames must be at least 1, got {frames}")
        motions = [b.resampled(self.network.config.fps, frames) for b in unique]
        known = self._known(garments, single, first_vertices, history)
        given = known.shape[0]
        lengths = [min(motions[number[id(b)]].frames, frames or 2**62) for b in bodies]
        if min(lengths) < given:
            raise ValueError(f"history has {given} frames, the shortest motion (or frames=) {min(lengths)}")

        def body_at(frame: int) -> torch.Tensor:
            return self._positions([m.vertices[min(frame, m.frames - 1)] for m in motions])

        packed = PackedBodies.pack(
            [m.faces for m in motions],
            [m.vertices.shape[1] for m in motions],
            [number[id(b)] for b in bodies],
            self.device,
        )
        first = [body_at(frame) for frame in range(given)]
        states = self._begin(garments, single, packed, known, first, face_splits)
        state, total = states[0], max(lengths)
        recording = Recording(states[0].scene, lengths, READ_EVERY if self.device.type == "cuda" else 1)
        with evaluating(self.network):
            for frame in counted(range(total), progress):
                state = self._advance(state, body_at(frame)) if frame >= given else states[frame]
                if not recording.add(state.now.outcome, last=frame == total - 1):
                    break
        results = []
        for i, (worn, statuses) in enumerate(zip(garments, recording.statuses, strict=True)):
            if not statuses[-1].finite:
                label = worn.name or f"garment {i}"
                warnings.warn(f"{label} stopped: {statuses[-1].message}", RuntimeWarning, stacklevel=2)
            moved = recording.positions[i][: len(statuses)]
            results.append(GarmentMotion(moved, worn.faces, self.network.config.fps, statuses, worn.name))
        return results[0] if single else results

    @overload
    def start(
        self, garment: Garment, body_vertices: Any, body_faces: Any, *, first_vertices: Any = None, face_splits: int = 1
    ) -> SimulationState[np.ndarray, RolloutStatus]: ...

    @overload
    def start(
        self,
        garment: Sequence[Garment],
        body_vertices: Any,
        body_faces: Any,
        *,
        first_vertices: Any = None,
        face_splits: int = 1,
    ) -> SimulationState[list[np.ndarray], list[RolloutStatus]]: ...

    def start(
        self,
        garment: Garment | Sequence[Garment],
        body_vertices: Any,
        body_faces: Any,
        *,
        first_vertices: Any = None,
        face_splits: int = 1,
    ) -> SimulationState[Any, Any]:
        """Starts a simulation on a body whose motion is not known yet; call `step` once per frame of `config.fps`.

        Args:
            garment: One or a list.
            body_vertices: The body in the first frame [m], shape [U,3]; a list, one for each garment, or one for all.
            body_faces: Its faces, shape [G,3]; a list where `body_vertices` is one.
            first_vertices: As in `rollout`.
            face_splits: As in `rollout`.

        Returns:
            The state at frame 0.

        Raises:
            ValueError, MeshError, NotEnoughMemory: As `rollout`.
        """
        garments, single = listed(garment, Garment)
        if isinstance(body_vertices, (list, tuple)):
            if len(body_vertices) != len(garments) or len(body_faces) != len(garments):
                raise ValueError(
                    f"{len(garments)} garments, {len(body_vertices)} bodies and {len(body_faces)} arrays of body "
                    "faces; give one of each per garment, or one body for all"
                )
            shapes, faces, on = list(body_vertices), list(body_faces), list(range(len(garments)))
        else:
            shapes, faces, on = [body_vertices], [body_faces], [0] * len(garments)
        checked = [
            BodyMotion(as_array(v)[None], f, self.network.config.fps) for v, f in zip(shapes, faces, strict=True)
        ]
        packed = PackedBodies.pack([b.faces for b in checked], [b.vertices.shape[1] for b in checked], on, self.device)
        known = self._known(garments, single, first_vertices, None)
        first = self._positions([b.vertices[0] for b in checked])
        return self._begin(garments, single, packed, known, [first], face_splits)[0]

    def step(
        self, state: SimulationState[Vertices, Status], next_body_vertices: Any
    ) -> SimulationState[Vertices, Status]:
        """One frame on.

        Args:
            state: From `start` or `step`; stays as it is.
            next_body_vertices: The body in the next frame [m], shape [U,3]; a list where `start` was given one. Copied.

        Returns:
            The next state. Once a garment is not finite it stays so, and its vertices are NaN.

        Raises:
            ValueError: Another number of bodies or vertices than at the start.
            MeshError: Positions that are not finite.
        """
        listed = isinstance(next_body_vertices, (list, tuple))
        arrays = [as_array(v) for v in (next_body_vertices if listed else [next_body_vertices])]
        body = self._positions(arrays)
        if body.shape != state.now.body.shape:
            raise ValueError(f"bodies had {len(state.now.body)} vertices at the start, now there are {len(body)}")
        if not all(np.isfinite(array).all() for array in arrays):
            raise MeshError(f"body_vertices of frame {state.frame + 1} hold NaN or infinity; skip or repair the frame")
        with evaluating(self.network):
            return self._advance(state, body)

    @torch.inference_mode()
    def _begin(
        self,
        garments: list[Garment],
        single: bool,
        bodies: PackedBodies,
        known: torch.Tensor,
        body_frames: list[torch.Tensor],
        face_splits: int,
    ) -> list[SimulationState[Any, Any]]:
        """States of the known frames [K,V,3]: one for a cold start, H with a history."""
        scene = Scene(
            garments,
            bodies,
            body_frames[0],
            known[0],
            self.network,
            face_splits=face_splits,
            epsilon=self.epsilon,
            collision_passes=self.collision_passes,
            half=self.half,
            timings=self.timings,
            contact_sources=self.contact_sources,
            correctors=self.correctors,
        )
        history_length = self.network.config.history
        features = scene.features(known[0], body_frames[0], body_frames[0])
        history = History.cold(features, scene.packed.component_count, history_length)
        graph = GraphedFrames(scene) if self.graph else None
        finite = torch.ones(len(garments), dtype=torch.bool, device=self.device)
        unsolved = torch.zeros((2, 3), dtype=torch.float64, device=self.device)
        states: list[SimulationState[Any, Any]] = []
        for frame, (vertices, body) in enumerate(zip(known, body_frames, strict=True)):
            if frame:
                features = scene.features(known[frame - 1], body_frames[frame - 1], body)
                velocity = scene.centroids(vertices) - scene.centroids(known[frame - 1])
                history = history.followed(history.stacked(features), velocity)
            depth = scene.contact.depth(vertices, body)
            now = Frame(vertices, body, history.features, history.velocities, finite, depth, unsolved)
            states.append(SimulationState(scene, single, frame, now, graph))
        return states

    @torch.inference_mode()
    def _advance(
        self, state: SimulationState[Vertices, Status], next_body: torch.Tensor
    ) -> SimulationState[Vertices, Status]:
        scene = state.scene
        if state.graph is None or self.timings.synchronise:
            after = advance(scene, state.now, next_body)
        else:
            after = state.graph(state.now, next_body)
        return SimulationState(scene, state.single, state.frame + 1, after, state.graph)

    def _known(self, garments: list[Garment], single: bool, first: Any, history: Any) -> torch.Tensor:
        frames = known_frames(garments, single, first, history, self.network.config.history)
        return torch.from_numpy(frames).to(self.device)

    def _positions(self, arrays: Sequence[np.ndarray]) -> torch.Tensor:
        """Arrays [*,3] end to end on the device; always a copy, so that callers may reuse theirs.

        Pinned on the way to a GPU: from other memory the host would wait until all earlier work is done.
        """
        packed = torch.from_numpy(np.concatenate(arrays).astype(np.float32, copy=False))
        return packed.pin_memory().to(self.device, non_blocking=True) if self.device.type == "cuda" else packed
