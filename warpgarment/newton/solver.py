"""A Newton solver that moves cloth particles by a network."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Sequence
from typing import Any, Literal

import newton
import numpy as np
import torch
import warp as wp
from newton.solvers import SolverBase

from warpgarment.errors import UsageError
from warpgarment.nn.run import evaluating
from warpgarment.objects.fit import fit
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies
from warpgarment.objects.status import RolloutStatus
from warpgarment.sim.arguments import outfits
from warpgarment.sim.brought import Brought
from warpgarment.sim.outdoors import air_of, as_materials, as_wind
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.state import SimulationState, starting_states

from .axes import from_y_up, to_y_up
from .collider import ShapeCollider

Garments = Garment | Sequence[Garment] | Sequence[Sequence[Garment]]
BODY = ("body_q", "body_qd", "joint_q", "joint_qd")
SAME = 1e-4  # largest distance of vertices at which a body has only been moved and turned [m]


class SolverNeuralGarment(SolverBase):
    """Moves garments, which are the particles of a model, on the bodies of their worlds.

    The network makes a frame every 1/`fps` seconds (30 a second) whatever `dt` is. The solver keeps a clock of its own:
    a call of `step` that does not reach the next frame computes nothing. What particles do between two frames is
    `between`:

    - "hold": they stay where the newest frame has them. At the time of a frame they are exact.
    - "interpolate": they go from the last frame to the newest on a straight line, and are one frame late throughout.

    A call that reaches a frame takes the bodies at the frame's time from those of the last call and of this one, on a
    straight line between them. A `dt` of several frames computes all of them. Velocities of particles are the
    difference of the last two frames over the time between them.

    All worlds are one packed batch. Forces on particles, masses, `control` and `contacts` do not matter, gravity is
    what the network has learned, and garments do not act on bodies. Joints and bodies are not moved: that is another
    solver's work, or the user's.

    Args:
        model: The model.
        garments: The garments of a world, in the order in which `add_garment` added them, innermost first; for worlds
            with different ones a list with a list for each world. All particles of the model must be theirs.
        network: As of `Simulator.from_pretrained`, or a `Simulator`.
        state: State with which the simulation begins; None: as the model has bodies and particles. Garments lie on
            their bodies in it, at rest.
        shapes: Shapes that are bodies, see `ShapeCollider`.
        bodies: The state of a step whose `body_q` has the bodies at its end: "out" where another solver, or the user,
            has moved them in `state_out` before; "in" where `state_in` has them, which are then copied to `state_out`.
        between: What particles do between frames, see above.
        layers: Whether garments of a world are kept from crossing each other and themselves.
        materials: As of `Simulator.rollout`, in the order of the worlds.
        wind: Velocity of the air [m/s], shape [3], in the model's axes, for networks that read it; it may be set anew.
        simulator: Further arguments of `Simulator`.

    Attributes:
        collider: The bodies' meshes.
        fps: Frames of the network in a second.
        time: Time since the solver was made [s].

    Raises:
        ValueError: Particles are not those of the garments.
        MeshError: A garment is far from its bodies, or a shape has no inside.
        NotEnoughMemory: The worlds do not fit on the device together.
    """

    def __init__(
        self,
        model: newton.Model,
        garments: Garments,
        network: str | os.PathLike[str] | Simulator = "default",
        *,
        state: newton.State | None = None,
        shapes: Sequence[int] | None = None,
        bodies: Literal["out", "in"] = "out",
        between: Literal["hold", "interpolate"] = "hold",
        layers: bool = False,
        materials: Any = None,
        wind: Any = None,
        **simulator: Any,
    ) -> None:
        super().__init__(model)
        if bodies not in ("out", "in") or between not in ("hold", "interpolate"):
            raise UsageError(f'bodies must be "out" or "in", between "hold" or "interpolate", got {bodies}, {between}')
        device = torch.device(wp.device_to_torch(model.device))
        self._simulator = (
            network if isinstance(network, Simulator) else Simulator.from_pretrained(network, device, **simulator)
        )
        self._bodies, self._between, self._axis = bodies, between, int(model.up_axis)
        self.collider, self.wind = ShapeCollider(model, shapes), wind
        self.fps = float(self._simulator.network.config.fps)
        self._garments, self._on = _of_worlds(model, garments)
        counts = [len(garment.vertices) for garment in self._garments]
        begin: Any = model if state is None else state
        with self._stream():
            placed = to_y_up(begin.particle_q.numpy(), self._axis)
            self._first = np.split(placed, np.cumsum(counts)[:-1])
            self._rest_bodies = self.collider.split(self.collider.at(begin))
            self._of_particle = torch.repeat_interleave(torch.tensor(self._on), torch.tensor(counts)).to(device)
            self._plain = all(garment.simulated.whole for garment in self._garments)
            self._state = self._started(begin, layers, materials)
            self.time, self._frames = 0.0, 0
            self._body = self._state.now.body
            self._newest = self._positions()
            self._last = self._newest

    @property
    def status(self) -> list[RolloutStatus]:
        """One status for each garment, world after world, of the newest frame. Reading it waits for a GPU."""
        return list(self._state.status)

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: SolverBase.Observables | None = None,
    ) -> None:
        """Writes positions and velocities of the particles at the end of a step to `state_out`.

        Args:
            state_in: State at its beginning.
            state_out: State at its end.
            control: Not used.
            contacts: Not used.
            dt: Length of the step [s].
            observables: Not used: this solver has none.

        Raises:
            ValueError: `dt` is negative or not finite.
        """
        if not (dt >= 0.0 and np.isfinite(dt)):
            raise ValueError(f"dt must be a time of at least 0 s, got {dt}")
        if self._bodies == "in" and state_in is not state_out:
            for name in BODY:
                source, target = getattr(state_in, name), getattr(state_out, name)
                if source is not None and target is not None:
                    wp.copy(target, source)
        with self._stream():
            body, begun = self.collider.at(state_out), self.time
            self.time = begun + dt
            reached = int(np.floor(self.time * self.fps + 1e-6))
            for frame in range(self._frames + 1, reached + 1):
                share = min(max((frame / self.fps - begun) / dt, 0.0), 1.0)
                self._advance(torch.lerp(self._body, body, share) if share < 1.0 else body)
                self._frames = frame
            self._body = body
            self._write(state_out)

    def reset(
        self,
        state: newton.State,
        world_mask: wp.array | None = None,
        flags: newton.StateFlags | int | None = None,
    ) -> None:
        """Puts the garments of worlds on their bodies again, at rest, as they were at the beginning.

        The bodies are where `state.body_q` has them: a body that has only been moved and turned as a whole since the
        model was made carries its garments along exactly, for another pose they are fitted (`wg.fit`). Particles of
        `state` are written for these worlds, also where it is called between two frames. Other worlds go on as they
        were.

        Args:
            state: The state, whose particles are changed.
            world_mask: As of `SolverBase.reset`, bool [worlds + 1]; None: all.
            flags: Not used.
        """
        mask = self._normalize_reset_world_mask(world_mask)
        worlds = max(1, self.model.world_count)
        chosen = np.ones(worlds, bool) if mask is None else mask.numpy()[:worlds]
        if self.model.world_count <= 1 and mask is not None:
            chosen = np.array([mask.numpy().any()])
        if not chosen.any():
            return
        with self._stream():
            body = self.collider.at(state)
            bodies = self.collider.split(body)
            parts = [
                carried(garment, first, self._rest_bodies[world], self.collider.faces[world], bodies[world])
                if chosen[world]
                else first
                for garment, first, world in zip(self._garments, self._first, self._on, strict=True)
            ]
            self._restart(parts, body, torch.tensor(chosen, device=body.device))
            self._write(state, torch.tensor(chosen, device=body.device))

    def _started(self, state: Any, layers: bool, materials: Any) -> SimulationState[Any, Any]:
        """The state at the beginning, of all worlds."""
        simulator, body = self._simulator, self.collider.at(state)
        faces, counts = self.collider.faces, self.collider.counts
        packed = PackedBodies.pack(faces, counts, self._on, simulator.device)
        brought = Brought(self._garments, np.concatenate(self._first)[None].astype(np.float32))
        known = as_materials(materials, len(self._garments), simulator.network, simulator.device)
        worn = outfits(True, self._on) if layers else []
        return simulator._begin(brought, False, packed, [body], 1, worn, known, [self._air()])[0]

    def _advance(self, next_body: torch.Tensor) -> None:
        """Makes a frame."""
        with evaluating(self._simulator.network):
            self._state = self._simulator._advance(self._state, next_body, self._air())
        self._last, self._newest = self._newest, self._positions()

    def _restart(self, parts: list[np.ndarray], body: torch.Tensor, worlds: torch.Tensor) -> None:
        """Starts the garments of some worlds anew.

        Args:
            parts: Where they begin [m], [V,3] each; of garments of other worlds anything of that shape.
            body: Bodies of all worlds [m], packed, [U,3].
            worlds: Whether a world is started anew, bool [W].
        """
        state, scene, now = self._state, self._state.scene, self._state.now
        assert scene.brought is not None
        garments = worlds[torch.tensor(self._on, device=worlds.device)]
        of_vertex, of_face = (
            garments[of.long()] for of in (scene.packed.garment_of_vertex, scene.packed.garment_of_face)
        )
        of_body = worlds[scene.packed_bodies.body_of_vertex.long()]
        begun = torch.from_numpy(scene.brought.reduced(parts)).to(body.device)
        with torch.inference_mode():
            known = picked(of_vertex, begun, now.positions)
            known_body = picked(of_body, body, now.body)
            cold = starting_states(scene, False, known[None], [known_body], [self._air()], state.graph)[0].now
            lengths = torch.tensor(np.diff(scene.packed.component_offsets), device=body.device)
            of_component = torch.repeat_interleave(garments, lengths)
            masks = {"positions": of_vertex, "body": of_body, "features": of_face, "velocities": of_component}
            masks |= {"finite": garments, "depth": garments, "meeting": garments}
            masks |= {"previous": of_vertex, "previous_body": of_body, "wind": garments}
            merged = {
                name: picked(
                    mask, getattr(cold, name), getattr(now, name), name in ("previous", "previous_body", "wind")
                )
                for name, mask in masks.items()
            }
        self._state = dataclasses.replace(state, now=now._replace(**merged))
        self._body = picked(of_body, body, self._body)
        shown = torch.from_numpy(np.concatenate(parts)).to(body.device, torch.float32)
        mine = worlds[self._of_particle]
        self._last, self._newest = picked(mine, shown, self._last), picked(mine, shown, self._newest)

    def _positions(self) -> torch.Tensor:
        """All vertices at the newest frame [m], Y up, [P,3]; of a garment that has failed the last finite ones."""
        if self._plain:
            return self._state.now.positions
        found = torch.from_numpy(np.concatenate(self._state.vertices)).to(self._simulator.device)
        return torch.where(torch.isfinite(found), found, self._newest) if hasattr(self, "_newest") else found

    def _write(self, state: newton.State, worlds: torch.Tensor | None = None) -> None:
        """Writes the particles of all worlds, or of those whose entry in `worlds` [W] is True."""
        positions = self._newest
        if self._between == "interpolate":
            share = min(max(self.time * self.fps - self._frames, 0.0), 1.0)
            positions = torch.lerp(self._last, self._newest, share)
        velocities = (self._newest - self._last) * self.fps
        for name, values in (("particle_q", positions), ("particle_qd", velocities)):
            target = wp.to_torch(getattr(state, name), requires_grad=False)
            written = from_y_up(values, self._axis)
            target.copy_(written if worlds is None else picked(worlds[self._of_particle], written, target))

    def _air(self) -> torch.Tensor | None:
        """Velocity of the air at each garment [m/s], [B,3], Y up; None: still, or as it was."""
        if self.wind is None:
            return None
        blowing = to_y_up(np.asarray(self.wind, dtype=np.float32).reshape(3), self._axis)
        wind = as_wind(blowing, len(self._garments), self._simulator.network, frame=0)
        return air_of(wind, 0, self._simulator.device)

    def _stream(self) -> Any:
        """Lets torch work on the stream on which Warp does, so that neither reads what the other has yet to write."""
        if self._simulator.device.type != "cuda":
            return contextlib.nullcontext()
        return torch.cuda.stream(wp.stream_to_torch(self.model.device))


def picked(mask: torch.Tensor, new: torch.Tensor, old: torch.Tensor, second: bool = False) -> torch.Tensor:
    """Rows of `new` where the mask is True, and of `old` elsewhere; of the second dimension if `second` is set."""
    if not old.numel():
        return old
    shape = [1] * old.ndim
    shape[int(second)] = len(mask)
    return torch.where(mask.reshape(shape), new, old)


def carried(garment: Garment, first: np.ndarray, before: np.ndarray, faces: np.ndarray, now: np.ndarray) -> np.ndarray:
    """A garment's vertices [V,3] on its body, which is `now` where it was `before` [m], [U,3]."""
    centre, place = before.mean(0), now.mean(0)
    u, _, vt = np.linalg.svd((before - centre).T.astype(np.float64) @ (now - place))
    turn = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    if np.abs((before - centre) @ turn.T + place - now).max() < SAME:
        return np.asarray((first - centre) @ turn.T + place, dtype=np.float32)
    modelled = Garment(first, garment.faces, name=garment.name)
    return np.asarray(fit(modelled, (before, faces), now), dtype=np.float32)


def _of_worlds(model: newton.Model, garments: Garments) -> tuple[list[Garment], list[int]]:
    """Garments of all worlds in the order of their particles, and the world of each.

    Raises:
        ValueError: Their vertices are not the particles of the model.
    """
    worlds = max(1, model.world_count)
    each: list[Any] = [garments] if isinstance(garments, Garment) else list(garments)
    if all(isinstance(item, Garment) for item in each):
        each = [each] * worlds
    if len(each) != worlds:
        raise ValueError(f"{worlds} worlds and garments for {len(each)}; give a list for each, or one for all")
    found = [(garment, world) for world, listed in enumerate(each) for garment in listed]
    begins: Any = model.particle_world_start
    starts = begins.numpy() if model.world_count else np.array([0, model.particle_count])
    for world in range(worlds):
        wanted = sum(len(garment.vertices) for garment, on in found if on == world)
        there = int(starts[world + 1] - starts[world])
        if wanted != there:
            raise ValueError(
                f"world {world} has {there:,} particles, and its garments {wanted:,} vertices. Add each with "
                "add_garment, and no other particles."
            )
    if (model.world_count and int(starts[worlds]) != model.particle_count) or int(starts[0]):
        raise ValueError("the model has particles that belong to no world. This solver moves garments only.")
    return [garment for garment, _ in found], [world for _, world in found]
