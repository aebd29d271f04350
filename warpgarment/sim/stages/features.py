"""Step 1 of a frame: the features of each face, which the network reads."""

from __future__ import annotations

import torch

from warpgarment.kernels.deformation.face_means import FaceMeans
from warpgarment.kernels.deformation.gradients import face_centroids
from warpgarment.kernels.features.channels import FEATURES, LAYOUT
from warpgarment.kernels.features.face import BodyInteraction, body_interaction, face_features
from warpgarment.kernels.features.frame import frame_features
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.bodies import MovingBodies
from warpgarment.sim.timing import Timings


class Features:
    """Features of the faces of a batch.

    Args:
        packed: The batch.
        inverse_rest: Inverse rest frames of the faces, see `inverse_rest_frames`, shape [F,3,3].
        body_of_face: Body of each face, int32 [F].
        bodies: The bodies.
        timings: Times of the stages, to which this one adds its own as "features".

    Attributes:
        sliding: Whether gradients take the nearest body point of a face as one that slides along its flat body face, so
            that the direction to the body is constant; otherwise as one that stays where it is, so that the direction
            turns. The former is closer to what finite differences give.
    """

    sliding = False

    def __init__(
        self,
        packed: PackedGarments,
        inverse_rest: torch.Tensor,
        body_of_face: torch.Tensor,
        bodies: MovingBodies,
        timings: Timings,
    ) -> None:
        self._packed, self._inverse_rest, self._body_of_face = packed, inverse_rest, body_of_face
        self._bodies, self._timings = bodies, timings
        of = packed.garment_of_face, packed.count, len(packed.rest_vertices), packed.garment_of_vertex
        self._means = FaceMeans(packed.faces, *of)

    def __call__(self, vertices: torch.Tensor, body: torch.Tensor, next_body: torch.Tensor) -> torch.Tensor:
        """Features of frame t.

        One launch computes them. If the positions require a gradient, they are computed operator by operator, with the
        nearest body face of each face held fixed.

        Args:
            vertices: Garments at t [m], shape [V,3].
            body: Bodies at t [m], shape [U,3].
            next_body: Bodies at t+1 [m], shape [U,3].

        Returns:
            Features, shape [F,34].
        """
        packed = self._packed
        with self._timings("features"):
            bodies = self._bodies.at(body)
            if vertices.requires_grad:
                centroids = face_centroids(vertices.detach(), packed.faces)
                interaction = body_interaction(centroids, self._body_of_face, bodies, next_body)
                return self.of_interaction(vertices, interaction)
            return frame_features(
                self._inverse_rest,
                vertices,
                packed.faces,
                packed.garment_of_face,
                self._means(vertices),
                self._body_of_face,
                bodies,
                next_body,
            )

    def of_interaction(self, vertices: torch.Tensor, interaction: BodyInteraction) -> torch.Tensor:
        """Features of a frame from nearest body faces that are already known.

        Args:
            vertices: Garments [m], shape [V,3].
            interaction: The result of `body_interaction` for the faces.

        Returns:
            Features, shape [F,34].
        """
        packed, mean = self._packed, self._means(vertices)
        found = face_features(self._inverse_rest, vertices, packed.faces, packed.garment_of_face, mean, interaction)
        if not (self.sliding and found.requires_grad):
            return found
        columns = LAYOUT["direction_to_body"]
        before, direction, after = found.split([columns.start, 3, FEATURES - columns.stop], dim=1)
        return torch.cat([before, direction.detach(), after], dim=1)
