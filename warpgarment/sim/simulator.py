"""The simulator: garments on moving bodies, frame by frame (Algorithm 1).

`rollout` takes whole motions, `start` and `step` take one body pose at a time. Both run the same code on a packed
batch; one garment is a batch of one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
import torch

from warpgarment.errors import UsageError
from warpgarment.kernels.collision.body_contacts import BodyContacts
from warpgarment.kernels.collision.contact_set import ContactSource
from warpgarment.kernels.threads import torch_on_one
from warpgarment.nn import checkpoint
from warpgarment.nn.device import device_of
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.run import evaluating
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.outfit import Outfit
from warpgarment.objects.pack import PackedBodies
from warpgarment.objects.status import RolloutStatus
from warpgarment.sim.stages.correct import Corrector

from .advance import advance
from .arguments import Layers, counted, given_bodies, known_frames, next_bodies, outfits, packed_on, per_garment
from .brought import Brought
from .graph import GraphedFrames
from .outdoors import Materials, air_of, as_materials, as_wind
from .results.recording import READ_EVERY, Recording, seen
from .results.shot import Rate, bodies_of_shot, brought_to_shot, frames_needed, rates_of
from .scene import Scene
from .state import SimulationState, Status, Vertices, starting_states
from .timing import Timings
from .worn.given import numbered, unfolded
from .worn.order import warn_of_wrong_order


class Simulator:
    """Moves garments with a network.

    Args:
        network: The network. It is moved to the device, and runs in evaluation mode.
        device: Device, "cpu", "cuda", ...; None takes a GPU if there is one.
        epsilon: Distance that collision refinement keeps between vertices and body [m]. None takes 4 mm, or a fifth of
            a garment's mean edge length if that is more, since a body shows through between the vertices of coarse
            cloth.
        collision_passes: Largest number of collision refinements per frame. They are repeated while any point of a
            garment is more than 0.1 mm deep; 0 leaves them out.
        half: Whether the transformer runs in bfloat16, which is faster on recent GPUs. Geometry stays in float32.
        graph: Whether what all frames do is recorded and replayed, as one CUDA graph (`graph.py`) or on a CPU by
            `kernels/replay`; None does. A graph is not replayed while `timings.synchronise` is set.

    Attributes:
        timings: Seconds per stage since the simulator was made, a dict. On CUDA, times are measured only while its
            attribute `synchronise` is set.
        contact_sources: List of contact sources for simulations that are started later, at first `[BodyContacts()]`.
        physics: Iterations of the cloth's own physics in a frame (`stages/relax.py`), for simulations that are started
            later; at first those of the network's configuration. 0 leaves them out.
        correctors: List of correctors for simulations that are started later, in their order, at first empty.
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
        replayed = graph is None or graph
        self.graph, self.replay = replayed and self.device.type == "cuda", replayed and self.device.type == "cpu"
        self.network = network.to(self.device)
        self.epsilon, self.collision_passes, self.half = epsilon, int(collision_passes), half
        self.timings = Timings(self.device)
        self.contact_sources: list[ContactSource] = [BodyContacts()]
        self.physics = network.config.physics
        self.correctors: list[Corrector] = []

    @classmethod
    def from_pretrained(
        cls, name: str | os.PathLike[str] = "default", device: torch.device | str | None = None, **options: Any
    ) -> Simulator:
        """A simulator with a trained network.

        Args:
            name: "default" (which depends on the device), the name of a network that ships, a checkpoint file, a folder
                that holds one, or a Hugging Face repository `owner/name[@revision]` (extra `hub`).
            device: Device, as in the constructor.
            options: Further arguments of the constructor.

        Raises:
            CheckpointError: There is no such network, it is damaged, or it cannot be fetched.
            MissingExtra: The name can only be a repository, and huggingface-hub is not installed.
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
        out_fps: Rate = None,
        face_splits: int = 1,
        layers: Layers = None,
        progress: bool = False,
        materials: Materials = None,
        wind: Any = None,
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
        out_fps: Rate = None,
        face_splits: int = 1,
        layers: Layers = None,
        progress: bool = False,
        materials: Materials = None,
        wind: Any = None,
    ) -> list[GarmentMotion]: ...

    @overload
    def rollout(
        self,
        garment: Sequence[Outfit],
        body: BodyMotion | Sequence[BodyMotion],
        *,
        first_vertices: Any = None,
        history: Any = None,
        frames: int | None = None,
        out_fps: Rate = None,
        face_splits: int = 1,
        layers: Layers = None,
        progress: bool = False,
        materials: Materials = None,
        wind: Any = None,
    ) -> list[list[GarmentMotion]]: ...

    def rollout(
        self,
        garment: Garment | Sequence[Garment] | Sequence[Outfit],
        body: BodyMotion | Sequence[BodyMotion],
        *,
        first_vertices: Any = None,
        history: Any = None,
        frames: int | None = None,
        out_fps: Rate = None,
        face_splits: int = 1,
        layers: Layers = None,
        progress: bool = False,
        materials: Materials = None,
        wind: Any = None,
    ) -> GarmentMotion | list[GarmentMotion] | list[list[GarmentMotion]]:
        """Simulates garments over motions of their bodies, as one batch.

        Frame 0 is the garment as given: draped on the body's first frame, at rest. Bodies are resampled to the
        network's rate. Results start when their body starts, and last as long. All vertices of a garment come back in
        their order: joined seams are simulated once, small loose pieces are carried by the cloth
        (`Garment.simulated`). Garments whose motion is shorter stop earlier; one that stops being finite ends with that
        frame, which holds NaN, with a status that says so and a RuntimeWarning.

        On a CPU the result is repeated bit for bit, and is that of each garment alone if it has more than 512 faces.
        Networks other than those of patches may differ with the threads, up to a millimetre: docs/rounding.md.

        Args:
            garment: One garment, a list, an `Outfit`, or a list of outfits.
            body: One body for all, or a list with one for each garment, or for each of several outfits; it may repeat.
            first_vertices: Positions in the first frame [m], shape [V,3] (or a list), where they differ from the rest
                positions `garment.vertices`: see `wg.fit`.
            history: Known first frames, shape [H,V,3] (or a list) with H the network's `history`, of the body's first H
                frames. They are returned as they are, and the simulation goes on from them.
            frames: Largest number of frames of the result, known ones included; None for the whole motion.
            out_fps: Frames per second of the result: None for the network's; "body" for those of each body, frame by
                frame; or a number. Between the network's frames positions are interpolated in time, moved out of the
                body at that time, and measured.
            face_splits: Number of interleaved subsets of the faces that the network sees one at a time. More subsets
                take less time and memory.
            layers: Which garments are worn together, and so kept from crossing each other and themselves. None: the
                garments of a list are independent of each other. True: all garments on the same body are one outfit,
                in the order of the list, innermost first; a single garment is kept from crossing itself. Or a list of
                outfits, each a list of numbers of garments, innermost first, such as `[[0, 1], [2, 3, 4]]`.
            progress: Whether to show a progress bar.
            materials: Material of all garments, or a list with one, or None, for each; for networks that read them.
            wind: A `wg.Wind`, or velocity of the air [m/s], shape [3], [T,3] or [T,B,3], at the network's rate; the
                last row holds on. For networks that read it.

        Returns:
            A `GarmentMotion`; a list for several garments or an outfit; for outfits, a list for each; so of `history`.

        Raises:
            ValueError: Lists have different lengths, arrays have other shapes, both `first_vertices` and `history`
                are given, `layers` name a garment that does not exist, twice, or on another body, or `materials` or
                `wind` are given for a network that does not read them.
            MeshError: A garment is more than 1 m from its body, or positions are not finite.
            NotEnoughMemory: The batch would not fit on the device; the message names settings with which it would.
            UsageError: `frames` is less than 1.
        """
        told = unfolded(garment, body, layers, materials, first_vertices, history)
        garments, single = told.garments, told.single
        unique, on = numbered(per_garment(told.body, BodyMotion, len(garments), "bodies"))
        if frames is not None and frames < 1:
            raise UsageError(f"frames must be at least 1, got {frames}")
        rates = rates_of(unique, out_fps, fps := self.network.config.fps)
        needed = [frames_needed(frames, rate, fps) for rate in rates]
        motions = [b.resampled(fps, count) for b, count in zip(unique, needed, strict=True)]
        brought = Brought(garments, known_frames(garments, single, self.network.config.history, *told.starts))
        given = len(brought.known)
        shot = bodies_of_shot(unique, rates, frames, garments, on) if any(rate != fps for rate in rates) else None
        lengths = [min(motions[i].frames, needed[i] or 2**62) for i in on]
        if min(lengths) < given:
            raise ValueError(f"history has {given} frames, the shortest motion (or frames=) {min(lengths)}")

        def body_at(frame: int) -> torch.Tensor:
            return packed_on([m.vertices[min(frame, m.frames - 1)] for m in motions], self.device)

        packed = PackedBodies.pack([m.faces for m in motions], [m.vertices.shape[1] for m in motions], on, self.device)
        first = [body_at(frame) for frame in range(given)]
        known_materials = as_materials(told.materials, len(garments), self.network, self.device)
        blown, worn = as_wind(wind, len(garments), self.network), outfits(told.layers, on)
        blowing = [air_of(blown, frame, self.device) for frame in range(max(lengths))]
        with torch.inference_mode():
            states = self._begin(brought, single, packed, first, face_splits, worn, known_materials, blowing[:given])
        state, total = states[0], max(lengths)
        recording = Recording(states[0].scene, lengths, READ_EVERY if self.device.type == "cuda" else 1)
        with evaluating(self.network):
            for frame in counted(range(total), progress):
                known = frame < given
                state = states[frame] if known else self._advance(state, body_at(frame), blowing[frame])
                if not recording.add(seen(state.scene, state.now.outcome, state.now.body), last=frame == total - 1):
                    break
        returned = brought.given if history is not None else None
        results = recording.motions(garments, [motions[i].clock for i in on], fps, returned)
        if shot is not None:
            results = brought_to_shot(states[0].scene, results, on, shot, motions, rates, frames)
        return told.folded(results)

    @overload
    def start(
        self,
        garment: Garment,
        body_vertices: Any,
        body_faces: Any,
        *,
        first_vertices: Any = None,
        face_splits: int = 1,
        layers: Layers = None,
        materials: Materials = None,
        wind: Any = None,
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
        layers: Layers = None,
        materials: Materials = None,
        wind: Any = None,
    ) -> SimulationState[list[np.ndarray], list[RolloutStatus]]: ...

    def start(
        self,
        garment: Garment | Sequence[Garment],
        body_vertices: Any,
        body_faces: Any,
        *,
        first_vertices: Any = None,
        face_splits: int = 1,
        layers: Layers = None,
        materials: Materials = None,
        wind: Any = None,
    ) -> SimulationState[Any, Any]:
        """Starts a simulation on a body whose motion is not known yet; call `step` once per frame of `config.fps`.

        Args:
            garment: One garment, a list, or an `Outfit`.
            body_vertices: Body in the first frame [m], shape [U,3], for all garments; or a list with one for each.
            body_faces: Vertex indices of its faces, shape [G,3]; a list if `body_vertices` is one.
            first_vertices: Positions in the first frame, as in `rollout`.
            face_splits: Number of subsets of the faces, as in `rollout`.
            layers: Which garments are worn together, as in `rollout`.
            materials: Materials, as in `rollout`.
            wind: A `wg.Wind`, or velocity of the air in the first frame [m/s], shape [3] or [1,B,3].

        Returns:
            The state at frame 0.

        Raises:
            ValueError, MeshError, NotEnoughMemory: As for `rollout`.
        """
        told = unfolded(garment, None, layers, materials, first_vertices, None)
        garments, single = told.garments, told.single
        checked, on = given_bodies(body_vertices, body_faces, len(garments), self.network.config.fps)
        packed = PackedBodies.pack([b.faces for b in checked], [b.vertices.shape[1] for b in checked], on, self.device)
        brought = Brought(garments, known_frames(garments, single, self.network.config.history, *told.starts))
        first = packed_on([b.vertices[0] for b in checked], self.device)
        known_materials = as_materials(told.materials, len(garments), self.network, self.device)
        air, worn = as_wind(wind, len(garments), self.network, frame=0), outfits(told.layers, on)
        with torch.inference_mode():
            blown = [air_of(air, 0, self.device)]
            return self._begin(brought, single, packed, [first], face_splits, worn, known_materials, blown)[0]

    def step(
        self, state: SimulationState[Vertices, Status], next_body_vertices: Any, *, wind: Any = None
    ) -> SimulationState[Vertices, Status]:
        """Simulates the next frame.

        Args:
            state: A state from `start` or `step`; it is not changed.
            next_body_vertices: Body in the next frame [m], shape [U,3]; a list if `start` was given one. It is copied.
            wind: Wind in the next frame, as in `start` (of a `wg.Wind` its row then); None leaves it as it is.

        Returns:
            The next state. A garment that is not finite stays so, and its vertices are NaN.

        Raises:
            ValueError: The number of bodies or of their vertices differs from that at the start.
            MeshError: Positions are not finite.
        """
        arrays = next_bodies(next_body_vertices, len(state.now.body), state.frame + 1)
        with evaluating(self.network):
            air = as_wind(wind, len(state.scene.garments), self.network, frame=state.frame + 1)
            return self._advance(state, packed_on(arrays, self.device), air_of(air, 0, self.device))

    def _begin(
        self,
        brought: Brought,
        single: bool,
        bodies: PackedBodies,
        body_frames: list[torch.Tensor],
        face_splits: int,
        layers: list[list[int]],
        materials: torch.Tensor | None,
        wind: Sequence[torch.Tensor | None],
    ) -> list[SimulationState[Any, Any]]:
        """States of the known frames: one for a cold start, H with a history.

        Args:
            brought, single, bodies, body_frames, face_splits: As in `rollout`, packed.
            layers: The result of `outfits`.
            materials: The result of `as_materials`.
            wind: As in `starting_states`.
        """
        garments, known = brought.simulated, torch.from_numpy(brought.known).to(self.device)
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
            physics=self.physics,
            correctors=self.correctors,
            brought=brought,
            layers=layers,
            materials=materials,
            replay=self.replay and not self.graph,
        )
        warn_of_wrong_order(scene, known[0], body_frames[0], layers)
        return starting_states(scene, single, known, body_frames, wind, GraphedFrames(scene) if self.graph else None)

    @torch.inference_mode()
    def _advance(
        self, state: SimulationState[Vertices, Status], next_body: torch.Tensor, wind: torch.Tensor | None
    ) -> SimulationState[Vertices, Status]:
        scene, now, graph = state.scene, state.now.blown(wind), None if self.timings.synchronise else state.graph
        with torch_on_one():
            after = advance(scene, now, next_body) if graph is None else graph(now, next_body)
        return SimulationState(scene, state.single, state.frame + 1, after, state.graph)
