"""What a training step differentiates: normalised inputs, feature noise, the transformer, the loss; one module, so that
it can be compiled, and wrapped for data-parallel training, as a whole.

With `precision="bfloat16"` the transformer runs under autocast: matrix products and attention in bfloat16 (softmax and
sums in float32 inside), layer norms in float32. Statistics, noise, targets and the loss stay float32, and so do the
weights, of which autocast makes copies.
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
from warpgarment.training.samples.single_step import Batch
from warpgarment.training.samples.unrolled import UnrolledBatch

from .losses import LossConfig, loss
from .unrolled_objective import UnrolledObjective


class CompileFailed(RuntimeError):
    """torch.compile did not work on this machine; the message says what it needs."""


class Objective(nn.Module):
    """Loss of a batch.

    Args:
        network: In training.
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
        """What `forward` takes."""
        return (
            batch.features,
            batch.velocities,
            batch.weights,
            batch.velocity_mask,
            batch.components,
            tuple(batch.target),
            batch.face_mask,
            batch.faces,
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
    ) -> torch.Tensor:
        """The fields of `Batch`; returns [4], the numbers of `Losses`, in float32."""
        rows = RowInputs(features, velocities, weights, face_mask, velocity_mask, in_network_frame=True)
        ran = run(self.network, rows, noise=self.noise, bfloat16=self.in_bfloat16, target=NetworkOutput(*target))
        assert ran.target is not None  # as one was given
        parts = velocity_mask, components, face_mask, faces
        return torch.stack(loss(ran.normalised, ran.target, self.network, self.config, *parts))


class Trainer:
    """An objective, compiled and shared between processes as asked.

    Gradients are averaged over the processes by DistributedDataParallel, while the backward pass still runs. Since all
    samples of a batch have the same number of faces and all processes the same number of samples, a mean of means is
    the mean over all faces; `Batch.components` makes it so for components.
    """

    def __init__(self, objective: Objective | UnrolledObjective, group: Group, compile: bool) -> None:
        self.compiled, self._worked = compile, False
        self._inputs: Callable[..., tuple] = objective.inputs  # of the batches that go with the objective
        if compile:
            objective.compile(dynamic=True)  # the number of faces changes from batch to batch
        self._model: nn.Module = objective
        if group.size > 1:
            self._model = DistributedDataParallel(objective, gradient_as_bucket_view=True)

    def backward(self, batch: Batch | UnrolledBatch) -> torch.Tensor:
        """Leaves the gradient in the weights, and returns this process's losses, which the objective's `figures` name;
        waits for nothing.

        Raises:
            CompileFailed: On the first step, where the compiler is not there.
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
