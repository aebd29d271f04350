"""The objective of training: feature noise, the network and the loss in one module, so that the whole can be compiled
and wrapped for data-parallel training.

With `precision="bfloat16"` the transformer runs under autocast: matrix products and attention in bfloat16 (softmax and
sums in float32 inside), layer norms in float32. Statistics, noise, targets, the loss and the weights, of which autocast
makes copies, stay float32.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from warpgarment.nn.inputs import RowInputs
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.run import run
from warpgarment.training.distributed import Group
from warpgarment.training.samples.outfits import OutfitBatch
from warpgarment.training.samples.single_step import Batch
from warpgarment.training.samples.unrolled import UnrolledBatch

from .losses import LossConfig, loss
from .position_objective import PositionObjective
from .unrolled_objective import UnrolledObjective


class CompileFailed(RuntimeError):
    """torch.compile failed on this machine; the message says what it needs."""


class Objective(nn.Module):
    """Loss of a batch.

    Args:
        network: The network in training.
        config: Weights and units of the loss.
        noise: Standard deviation of Gaussian noise on the normalised inputs; 0: none.
        precision: "float32" or "bfloat16".
    """

    figures = ("loss", "loss_deformation", "loss_singular_values", "loss_velocity")

    def __init__(self, network: GarmentNetwork, config: LossConfig, noise: float, precision: str) -> None:
        super().__init__()
        self.network, self.config, self.noise, self.in_bfloat16 = network, config, noise, precision == "bfloat16"

    @staticmethod
    def inputs(batch: Batch) -> tuple:
        """The arguments of `forward` for a batch."""
        return (
            batch.features,
            batch.velocities,
            batch.weights,
            batch.velocity_mask,
            batch.components,
            tuple(batch.target),
            batch.face_mask,
            batch.faces,
            batch.outdoor,
        )

    def forward(
        self,
        features: torch.Tensor,
        velocities: torch.Tensor,
        weights: Any,
        velocity_mask: torch.Tensor | None,
        components: torch.Tensor,
        target: tuple[torch.Tensor, ...],
        face_mask: torch.Tensor | None = None,
        faces: torch.Tensor | None = None,
        outdoor: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Loss of the fields of a `Batch`: the numbers of `Losses` in their order, float32 [4]."""
        rows = RowInputs(
            features, velocities, weights, face_mask, velocity_mask, in_network_frame=True, outdoor=outdoor
        )
        ran = run(self.network, rows, noise=self.noise, bfloat16=self.in_bfloat16, target=NetworkOutput(*target))
        assert ran.target is not None  # as one was given
        parts = velocity_mask, components, face_mask, faces
        return torch.stack(loss(ran.normalised, ran.target, self.network, self.config, *parts))


class Trainer:
    """Computes gradients of an objective, compiled if wanted, in one or several processes.

    DistributedDataParallel averages the gradients over the processes during the backward pass. All samples of a batch
    have the same number of faces, and all processes the same number of samples, so the mean of the processes' means is
    the mean over all faces. For components, and for padded faces, the divisors in `Batch` have the same effect.

    Args:
        objective: The objective.
        group: The processes that train together.
        compile: Whether to compile the objective.
    """

    def __init__(
        self, objective: Objective | UnrolledObjective | PositionObjective, group: Group, compile: bool
    ) -> None:
        self.compiled, self._worked = compile, False
        self._inputs: Callable[..., tuple] = objective.inputs  # from a batch to arguments of the objective
        if compile:
            objective.compile(dynamic=True)  # the number of faces changes from batch to batch
        self._model: nn.Module = objective
        if group.size > 1:
            self._model = DistributedDataParallel(objective, gradient_as_bucket_view=True)

    def backward(self, batch: Batch | UnrolledBatch | OutfitBatch) -> torch.Tensor:
        """Computes the gradient of the weights; the host does not wait for the device.

        Returns:
            The losses of this process, in the order of the objective's `figures`.

        Raises:
            CompileFailed: The compiler is missing, on the first step.
        """
        try:
            losses = self._model(*self._inputs(batch))
            losses[0].backward()
        except Exception as error:
            if not self.compiled or self._worked or not type(error).__module__.startswith(("torch._", "triton")):
                raise
            reason = " ".join(str(error).split())[:300]
            raise CompileFailed(
                f"torch.compile failed ({type(error).__name__}: {reason}). It needs Triton and a C compiler on a GPU, "
                "a C++ compiler on a CPU. Install them, or train without --compile."
            ) from error
        self._worked = True
        return losses.detach()
