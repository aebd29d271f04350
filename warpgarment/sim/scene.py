"""One batch of garments on bodies: the constants of a simulation, and the stages of a frame (`stages/`).

The stages of Algorithm 1 work on packed arrays: `features`, `predict` (the network), `reconstruct` (singular values and
Poisson solve), `relax` (a few iterations of physics, off by default), `contact` (collisions) and `correct` (does
nothing by default). A scene holds no garment positions; they
are in `state.SimulationState`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

import torch

from warpgarment.errors import MeshError
from warpgarment.kernels import compiling
from warpgarment.kernels.collision.body_contacts import BodyContacts
from warpgarment.kernels.collision.contact_set import ContactSource
from warpgarment.kernels.deformation.gradients import inverse_rest_frames
from warpgarment.kernels.features.skin import Skin, bind
from warpgarment.kernels.replay.pieces import Pieces
from warpgarment.kernels.threads import torch_on_all
from warpgarment.nn.architecture import architecture
from warpgarment.nn.inputs import FrameInputs, Frames, VertexStep
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import Step
from warpgarment.objects.clearance import clearance
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies, PackedGarments
from warpgarment.sim.stages.centroids import ComponentCentroids
from warpgarment.sim.stages.contact import Contact
from warpgarment.sim.stages.correct import Correct, Corrector
from warpgarment.sim.stages.features import Features
from warpgarment.sim.stages.reconstruct import Reconstruct
from warpgarment.sim.stages.relax import Relax

from . import memory
from .bodies import MovingBodies
from .brought import Brought
from .frame import FIGURES, Frame
from .history import Stacks
from .surface import Surface
from .timing import Timings

if TYPE_CHECKING:
    from warpgarment.sim.stages.meet import Meet

GIVEN = frozenset({"previous", "materials", "wind", "skin"})  # optional inputs of networks that simulations have
MOST_REPLAYED = 32_768
"""Faces of a batch up to which frames are replayed: of larger ones kernels take the time, and the memory counts."""
FARTHEST = 1.0  # metres; a garment whose nearest vertex is farther from its body has a wrong position or unit


class Scene:
    """Garments, bodies, and the stages of a frame.

    Args:
        garments: The garments, in the order of the batch.
        bodies: Topology of the bodies, and which garment is on which.
        body_vertices: Bodies in the first frame [m], packed, shape [U,3].
        first_vertices: Garments in the first frame [m], packed, shape [V,3].
        network: The network that `predict` runs.
        face_splits: Number of subsets of faces, as in `GarmentNetwork.layout`.
        epsilon: Distance that collision refinement keeps from the body [m]; None for the default of `clearance`.
        collision_passes: Largest number of refinements in a frame.
        half: Whether the transformer runs in bfloat16.
        timings: Times of the stages, to which each stage adds its own.
        contact_sources: Objects that find contacts, such as `BodyContacts()`.
        physics: Iterations of the cloth's own physics in a frame; None: as the network's configuration says.
        correctors: What changes positions after contact.
        brought: What users brought, where it is more than `garments`.
        layers: Garments of each outfit, innermost first, as numbers in the batch; see `arguments.outfits`.
        materials: Material of each garment, with the fields of `Material`, shape [B,M]; NaN for a garment without one.
            None if no garment has one.
        replay: Whether what is the same in every frame is recorded, and then replayed.

    Attributes:
        contact_sources: List of contact sources; more may be appended before the first frame.
        correctors: List of correctors; more may be appended before the first frame.

    Raises:
        MeshError: A garment is more than 1 m from its body.
        NotEnoughMemory: The batch would not fit on the device.
        ValueError: The network reads inputs that simulations do not have yet.
    """

    def __init__(
        self,
        garments: Sequence[Garment],
        bodies: PackedBodies,
        body_vertices: torch.Tensor,
        first_vertices: torch.Tensor,
        network: GarmentNetwork,
        *,
        face_splits: int,
        epsilon: float | None,
        collision_passes: int,
        half: bool,
        timings: Timings,
        contact_sources: Sequence[ContactSource] = (BodyContacts(),),
        physics: int | None = None,
        correctors: Sequence[Corrector] = (),
        brought: Brought | None = None,
        layers: Sequence[Sequence[int]] = (),
        materials: torch.Tensor | None = None,
        replay: bool = False,
    ) -> None:
        if missing := network.reads - GIVEN:
            raise ValueError(f"the network reads {', '.join(sorted(missing))}, which simulations do not give yet")
        self.packed_bodies = bodies
        self.materials = materials if "materials" in network.reads else None
        device = body_vertices.device
        self.garments, self.network, self.timings, self.half = list(garments), network, timings, half
        self.contact_sources, self.correctors = list(contact_sources), list(correctors)
        memory.check(
            garments,
            bodies,
            network.config,
            face_splits=face_splits,
            half=half,
            device=device,
            physics=physics,
            correctors=self.correctors,
            layers=layers,
        )
        if device.type == "cpu":
            compiling.ahead([*compiling.OF_A_FRAME, *network.launches])
        self.brought = brought
        self.packed = packed = PackedGarments.pack(garments, device)
        self.inverse_rest = inverse_rest_frames(packed.rest_vertices, packed.faces)
        self.bodies = MovingBodies(body_vertices, bodies)
        apart = architecture(network.config.architecture).apart
        self.stacks = Stacks(separate=network.takes_frames, apart=apart)
        body_of_vertex = bodies.body_of_garment[packed.garment_of_vertex.long()]
        body_of_face = bodies.body_of_garment[packed.garment_of_face.long()]
        self._refuse_far(first_vertices, body_of_vertex)
        self.layout = network.layout(garments, packed, face_splits=face_splits)
        self.skin: Skin | None = None
        if "skin" in network.reads:
            cloth, on, body = (part.cpu().numpy() for part in (first_vertices, body_of_vertex, body_vertices))
            self.skin = bind(cloth, on, body, bodies.vertex_offsets, device)

        margins = [clearance(garment) if epsilon is None else epsilon for garment in garments]
        self.centroids = ComponentCentroids(packed)
        self.features = Features(packed, self.inverse_rest, body_of_face, self.bodies, timings)
        self.reconstruct = Reconstruct(
            garments,
            packed,
            self.centroids,
            first_vertices=first_vertices,
            bodies=self.bodies.at(body_vertices),
            body_of_garment=bodies.body_of_garment,
            replace=network.config.replace_singular_values,
            timings=timings,
        )
        config = network.config
        iterations = config.physics if physics is None else physics
        self.relax = Relax(packed, iterations, config.physics_length, materials, timings)
        self.contact = Contact(
            packed,
            Surface(garments, packed),
            self.bodies,
            body_of_vertex=body_of_vertex,
            epsilon=torch.tensor(margins, device=device)[packed.garment_of_vertex.long()],
            sources=self.contact_sources,
            passes=collision_passes,
            timings=timings,
        )
        self.meet: Meet | None = None  # of garments of no outfit
        if layers:
            from warpgarment.sim.stages.meet import Meet  # with its kernels, which other simulations do without

            self.meet = Meet(packed, layers, first_vertices, self.contact, timings)
        self.correct = Correct(self.correctors, packed, self.contact.depth, timings)
        self.pieces = self.contact.pieces = Pieces(on=replay and len(packed.faces) <= MOST_REPLAYED)

    def begin(self, body_vertices: torch.Tensor, first_vertices: torch.Tensor) -> None:
        """Places the bodies anew, and ties pins to them; states and gradients of the scene so far are no longer usable.

        Args:
            body_vertices: Bodies in the first frame [m], packed, shape [U,3].
            first_vertices: Garments in the first frame [m], packed, shape [V,3].
        """
        if self.skin is not None:
            raise ValueError("a scene of a network that reads the skin begins once")
        self.reconstruct.hold(first_vertices, self.bodies.at(body_vertices))
        self.pieces.clear()

    def _refuse_far(self, vertices: torch.Tensor, body_of_vertex: torch.Tensor) -> None:
        """Raises MeshError for a garment whose vertices are all more than `FARTHEST` from its body."""
        assert self.bodies.placed is not None
        distance = self.bodies.at(self.bodies.placed).query(vertices, body_of_vertex).distance
        for number, of_garment in enumerate(distance.split(_lengths(self.packed.vertex_offsets))):
            nearest = of_garment.abs().min().item()
            if nearest > FARTHEST:
                name = self.garments[number].name or f"number {number}"
                raise MeshError(
                    f"garment {name} is {nearest:.2f} m from its body at the nearest vertex. Check that both are in "
                    "metres (Garment.load(..., unit=...)) and Y up, and bring the garment onto the first frame with "
                    "wg.dress (--dress), or with wg.fit (--fit-rest) if it was modelled on this body."
                )

    def measure_meeting(self, vertices: torch.Tensor, finite: torch.Tensor) -> torch.Tensor:
        """Figures of cloth that meets cloth, shape [B,4]: of `Meet.measure`, or NaN without an outfit.

        Args:
            vertices: Positions [m], shape [V,3].
            finite: Which garments are simulated, bool [B].
        """
        if self.meet is None:
            return vertices.new_full((self.packed.count, FIGURES), torch.nan)
        return self.meet.measure(vertices, finite)

    def inputs(self, now: Frame, features: torch.Tensor | Frames, next_body: torch.Tensor) -> FrameInputs:
        """What the network gets of a frame.

        Args:
            now: The frame t.
            features: Features of the history with frame t, shape [F,H,34].
            next_body: Bodies at t+1 [m], shape [U,3].
        """
        past = "previous" in self.network.reads
        return FrameInputs(
            features,
            now.velocities,
            now.positions,
            now.body,
            next_body,
            previous=now.previous if past else None,
            previous_body=now.previous_body if past else None,
            materials=self.materials,
            wind=now.wind if "wind" in self.network.reads else None,
            bodies=self.packed_bodies,
            skin=self.skin,
        )

    def replayed(self) -> object | None:
        """What a recording of the network's launches depends on, see `GarmentNetwork.replayed`."""
        if not self.pieces.on or self.half or torch.is_grad_enabled():
            return None
        return self.network.replayed(self.layout)

    def predict(self, inputs: FrameInputs) -> Step | VertexStep:
        """Step 2 of a frame: the network predicts the step to t+1."""
        with self.timings("network"), nullcontext() if self.network.shares_threads else torch_on_all():
            return self.network.predict(inputs, self.layout, bfloat16=self.half)


def _lengths(offsets: Sequence[int]) -> list[int]:
    return [after - before for before, after in itertools.pairwise(offsets)]
