"""The base class of all networks: statistics, rows of garments, one frame of a simulation, files.

Each kind of network defines `forward_normalised`, which maps normalised inputs to normalised outputs; run.py does
everything around it. A network whose output is not one step per face also defines `layout` and `predict`. The meaning
of Psi, Sigma and q is in parametrisation.py. Statistics are buffers, so checkpoints hold them with the weights.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from warpgarment.kernels.deformation.steps import steps
from warpgarment.kernels.features.channels import FACE, FEATURES, LAYOUT, OUTDOOR
from warpgarment.kernels.features.outdoor import needs, packed_columns
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from . import checkpoint
from .attention import EncoderLayer
from .config import STATISTICS, NetworkConfig
from .heading import rotate_vectors
from .inputs import FrameInputs, Frames, NormalisedOutput, RowInputs, VertexStep
from .parametrisation import NetworkOutput, Step, component_mean, compose, context
from .rows import PaddedView, RowLayout, row_layout
from .run import normalised, run


class GarmentNetwork(nn.Module):
    """Predicts how each face deforms in the next frame, or where each vertex is.

    A residual network (`config.residual`) starts with zero output weights; the means of its Psi and q are identity and
    zero, so that, untrained, it moves the garment like skin. `set_statistics` keeps those means.

    Args:
        config: Shape and settings of the network.

    Attributes:
        reads: Names of the optional fields of `FrameInputs` that `predict` needs: `previous`, `materials`, `wind`,
            `pairs`, `skin`. Outdoor channels of `config` add those that they need.
        shares_threads: Whether it uses the pool of `kernels/threads.py` on a CPU. Others get torch's threads.
        statistics: Buffers of the normalisation and their lengths.
    """

    reads: frozenset[str] = frozenset()
    shares_threads: bool = False
    statistics: Mapping[str, int] = STATISTICS

    embed_faces: nn.Linear
    face_head: nn.Linear
    velocity_head: nn.Linear
    feature_mean: torch.Tensor
    feature_std: torch.Tensor
    outdoor_mean: torch.Tensor
    outdoor_std: torch.Tensor
    velocity_mean: torch.Tensor
    velocity_std: torch.Tensor
    psi_mean: torch.Tensor
    psi_std: torch.Tensor
    singular_value_mean: torch.Tensor
    singular_value_std: torch.Tensor
    q_mean: torch.Tensor
    q_std: torch.Tensor

    @property
    def launches(self) -> tuple[str, ...]:
        """Modules of `warpgarment.kernels` with kernels that the network launches on a CPU; for `compiling.ahead`."""
        return ("deformation.steps",)

    @property
    def takes_frames(self) -> bool:
        """Whether `predict` takes `Frames`: networks that override it, or on which it is set, get one tensor."""
        return type(self).predict is GarmentNetwork.predict and "predict" not in vars(self)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.channels = FACE.only(config.channels)
        self.outdoor = OUTDOOR.only(config.outdoor)
        if width := self.outdoor.width:
            self.reads = self.reads | needs(config.outdoor)
            self.statistics = {**self.statistics, "outdoor_mean": width, "outdoor_std": width}
        for name, length in self.statistics.items():
            length = self.channels.width if name.startswith("feature_") else length
            start = torch.zeros(length) if name.endswith("_mean") else torch.ones(length)
            self.register_buffer(name, start)
        if "psi_mean" in self.statistics:
            self.psi_mean[::4].fill_(1.0)  # torch.eye without storage loads torch's compiler
            self.singular_value_mean.fill_(1.0)

    def encoder_layers(self) -> nn.ModuleList:
        """Untrained encoder layers on tokens of width `config.embedding`."""
        config = self.config
        return nn.ModuleList(
            EncoderLayer(
                config.embedding,
                config.feed_forward,
                config.heads,
                config.manifold_heads,
                dropout=config.dropout,
                norm_first=config.norm_first,
                activation=config.activation,
            )
            for _ in range(config.layers)
        )

    def start_like_skin(self) -> None:
        """Sets the output weights of a residual network to zero."""
        if self.config.residual:
            for head in (self.face_head, self.velocity_head):
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)

    def forward(
        self,
        face_features: torch.Tensor,
        velocities: torch.Tensor,
        weights: Any,
        *,
        face_mask: torch.Tensor | None = None,
        velocity_mask: torch.Tensor | None = None,
        outdoor: torch.Tensor | None = None,
    ) -> NetworkOutput:
        """Runs the network on rows of garments; inputs and outputs are in physical units and world space.

        Args:
            face_features: Stacked features, oldest first, shape [B,N,H*34].
            velocities: Past velocities of each component [m/frame], oldest first, shape [B,C,(H-1)*3].
            weights: How the faces lie on the cloth: for a `ManifoldAwareTransformer` the geodesic weights [B,N,N], zero
                in padded columns; for a `PatchTransformer` a `PatchLayout`. B may be 1 if all rows are of one garment.
            face_mask: True where a face is real, shape [B,N]; None where all are.
            velocity_mask: True where a component is real, shape [B,C]; None where all are.
            outdoor: Channels of the material and the wind, from `kernels.features.outdoor`, shape [B,N,K]. None
                for faces whose material is not known and that move with the air.

        Returns:
            The output, whose meaning is defined by `parametrisation.compose`. Padded entries are finite but arbitrary.
        """
        inputs = RowInputs(face_features, velocities, weights, face_mask, velocity_mask, outdoor=outdoor)
        return run(self, inputs).output

    def layout(self, garments: Sequence[Garment], packed: PackedGarments, *, face_splits: int = 1) -> Any:
        """The constants of a batch that `predict` needs, made once per simulation.

        Args:
            garments: The batch.
            packed: The same garments, packed on the device.
            face_splits: Number of disjoint subsets of each garment's faces that the network sees one at a time. Ignored
                if its `Architecture.subsets` is False.
        """
        return row_layout(packed, garments, self.config, face_splits)

    def predict(self, inputs: FrameInputs, layout: Any, *, bfloat16: bool = False) -> Step | VertexStep:
        """Predicts the step from frame t to t+1.

        Args:
            inputs: The batch at frame t.
            layout: The result of `layout`, here a `RowLayout`.
            bfloat16: Whether the network runs in bfloat16, as in `run`.
        """
        assert isinstance(layout, RowLayout)
        features, newest, velocities, outside = self.packed_inputs(inputs, layout)
        faces, components = len(newest), len(velocities)
        output = NetworkOutput(
            newest.new_empty((faces, 3, 3)), newest.new_empty((faces, 3)), newest.new_zeros((components, 3))
        )
        if newest.device.type == "cpu" and not (torch.is_grad_enabled() or bfloat16):
            for view in itertools.chain.from_iterable(view.one_by_one for view in layout.views):
                self._step(view, view.inputs(features, velocities, outside), newest, output)
            body = component_mean(newest[:, LAYOUT["body_velocity"]], layout.face_component, components)
            velocity = output.velocity + body if self.config.residual else output.velocity
            return Step(output.psi, output.singular_values, velocity)
        for view in layout.views:
            view.add_to(output, run(self, view.inputs(features, velocities, outside), bfloat16=bfloat16).output)
        moved = context(newest, layout.face_component, components)
        return compose(output, moved, residual=self.config.residual)

    def replayed(self, layout: Any) -> object | None:
        """What launches of `predict` are made from, if they are all that it does on this device, so that they can be
        recorded and replayed: another object once weights have changed. None, as here, if they cannot.

        Args:
            layout: The result of `layout`.
        """
        return None

    def packed_inputs(
        self, inputs: FrameInputs, layout: RowLayout
    ) -> tuple[torch.Tensor | Frames, torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """Features [F,H*34] or `Frames`, those of the newest frame [F,34], velocities [C,(H-1)*3] and outdoor channels
        [F,K] of a packed batch; None without any."""
        air = None if inputs.wind is None else inputs.wind[0]
        before = None if inputs.previous is None else inputs.previous[0]
        on = layout.faces, layout.garment_of_face
        outside = packed_columns(self.outdoor, self.config.fps, inputs.vertices, before, *on, inputs.materials, air)
        velocities = inputs.velocities.flatten(1)
        if isinstance(inputs.features, Frames):
            return inputs.features, inputs.features.frames[-1], velocities, outside
        features = inputs.features.flatten(1)
        return features, features[:, -FEATURES:], velocities, outside

    def _step(self, view: PaddedView, rows: RowInputs, newest: torch.Tensor, output: NetworkOutput) -> None:
        """Runs the network on a view and writes its steps: what `predict` does by operators, in a launch."""
        said, turn = normalised(self, rows)
        turn = torch.eye(3).expand(len(said.psi), 3, 3) if turn is None else turn
        scale = [self.psi_std, self.singular_value_std, self.psi_mean, self.singular_value_mean]
        steps(
            torch.cat([said.psi, said.singular_values], dim=-1),
            torch.cat(scale),
            turn.contiguous(),
            view.index,
            newest,
            LAYOUT["body_deformation"].start,
            (output.psi, output.singular_values),
            residual=self.config.residual,
        )
        velocity = rotate_vectors(said.velocity * self.q_std + self.q_mean, turn.mT)
        view.add_velocities(output.velocity, velocity)

    def observed(self, inputs: FrameInputs, layout: Any, after: torch.Tensor) -> dict[str, torch.Tensor]:
        """Numbers of which `statistics` holds the mean and deviation, for a network that predicts positions.

        Args:
            inputs: The batch at frame t.
            layout: The result of `layout`.
            after: Positions at t+1 [m], shape [V,3].

        Returns:
            Rows [*,K] by name, without "_mean" and "_std"; none, as here, if the network has no such statistics.
        """
        return {}

    def encode(self, face_features: torch.Tensor) -> torch.Tensor:
        """Normalises features in the network's frame; the same statistics serve all frames of the history."""
        x = (self.read(face_features).unflatten(-1, (-1, self.channels.width)) - self.feature_mean) / self.feature_std
        return x.flatten(-2)

    def read(self, face_features: torch.Tensor) -> torch.Tensor:
        """The channels of the features [...,H*34] that this network reads (`config.channels`), shape [...,H*K]."""
        if self.channels.names == FACE.names:
            return face_features
        return FACE.take(face_features.unflatten(-1, (-1, FEATURES)), self.channels.names).flatten(-2)

    def known(self, outdoor: torch.Tensor) -> torch.Tensor:
        """Outdoor channels [...,K] with the mean, which is zero after normalisation, where a material is not known."""
        return torch.where(outdoor.isnan(), self.outdoor_mean, outdoor)

    def with_outdoor(
        self, x: torch.Tensor, outdoor: torch.Tensor | None, face_mask: torch.Tensor | None, *, embedded: bool
    ) -> torch.Tensor:
        """Inputs of faces with their outdoor channels.

        Args:
            x: Normalised features, shape [R,N,H*K], or with `embedded` the result of the method `embedded`.
            outdoor: Channels in the network's frame, all of them known, shape [R,N,K]; None for zero when normalised.
            face_mask: True where a face is real, shape [R,N]; None where all are.
            embedded: Whether the first layer is already applied to x.
        """
        if not self.outdoor.width:
            return x
        if outdoor is None:
            outside = x.new_zeros((*x.shape[:-1], self.outdoor.width))
        else:
            outside = (outdoor - self.outdoor_mean) / self.outdoor_std
        if not embedded:
            return torch.cat([x, outside], dim=-1)
        if face_mask is not None:
            outside = torch.where(face_mask[..., None], outside, 0.0)
        return x + F.linear(outside, self.embed_faces.weight[:, -self.outdoor.width :])

    def encode_velocities(self, velocities: torch.Tensor) -> torch.Tensor:
        """Normalises velocities in the network's frame."""
        return ((velocities.unflatten(-1, (-1, 3)) - self.velocity_mean) / self.velocity_std).flatten(-2)

    def forward_normalised(
        self,
        x: torch.Tensor,
        v: torch.Tensor,
        rows: Any,
        *,
        face_mask: torch.Tensor | None = None,
        component_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The network itself: normalised inputs to normalised outputs.

        Args:
            x: Features of the channels it reads, oldest frame first, and after them its outdoor channels if it has any,
                shape [R,N,`config.inputs`].
            v: Velocities of components, shape [R,C,(H-1)*3].
            rows: The result of `Architecture.rows` for this kind of network.
            face_mask: True where a face is real, shape [R,N]; None where all are.
            component_mask: True where a component is real, shape [R,C]; None where all are.

        Returns:
            The output in float32, also under autocast. Padded entries are finite but arbitrary.
        """
        raise NotImplementedError

    def embedded(
        self, face_features: torch.Tensor, turn: torch.Tensor | None, face_mask: torch.Tensor | None
    ) -> torch.Tensor | None:
        """The first layer applied to features in world space, with turn and normalisation folded into its weights.

        Args:
            face_features: All channels, physical units, shape [R,N,H*K].
            turn: Rotation to the network's frame, shape [R,3,3]; None for no rotation.
            face_mask: As in `forward_normalised`.

        Returns:
            The argument of `forward_embedded`; None, as here, if the network has no such shortcut.
        """
        return None

    def embedded_rows(self, inputs: RowInputs, turn: torch.Tensor | None) -> torch.Tensor | None:
        """The same for rows that may be mirrored, turned with their rest pose, or have gradients in some frames alone.

        Args:
            inputs: The rows, in world space.
            turn: As above.
        """
        return None

    def forward_embedded(
        self,
        embedded: torch.Tensor,
        v: torch.Tensor,
        rows: Any,
        *,
        face_mask: torch.Tensor | None = None,
        component_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The same as `forward_normalised`, starting from the result of `embedded`."""
        raise NotImplementedError

    def denormalise(self, normalised: NormalisedOutput) -> NetworkOutput:
        """Normalised output to physical units (still in the canonical frame), in the precision of the statistics."""
        psi = normalised.psi * self.psi_std + self.psi_mean
        singular_values = normalised.singular_values * self.singular_value_std + self.singular_value_mean
        velocity = normalised.velocity * self.q_std + self.q_mean
        return NetworkOutput(psi.unflatten(-1, (3, 3)), singular_values, velocity)

    def normalise_targets(self, output: NetworkOutput) -> NormalisedOutput:
        """The inverse of `denormalise`."""
        psi = (output.psi.flatten(-2) - self.psi_mean) / self.psi_std
        singular_values = (output.singular_values - self.singular_value_mean) / self.singular_value_std
        return NormalisedOutput(psi, singular_values, (output.velocity - self.q_mean) / self.q_std)

    def set_statistics(self, statistics: Mapping[str, torch.Tensor]) -> None:
        """Replaces statistics of the normalisation.

        Args:
            statistics: Values by name, any of the attribute `statistics` and of the length given there. They describe
                inputs in the canonical frame, and targets from `parametrisation.targets` in the canonical frame.

        Raises:
            ValueError: An unknown name, a wrong length, a value that is not finite, a deviation that is not positive,
                or an output mean of a residual network that is not "moves like skin".
        """
        for name, value in statistics.items():
            if name not in self.statistics:
                raise ValueError(f"unknown statistic {name!r}; there are {', '.join(self.statistics)}")
            value = torch.as_tensor(value, dtype=torch.float32)
            length = len(getattr(self, name))
            if tuple(value.shape) != (length,):
                raise ValueError(f"{name} must have shape [{length}], got {list(value.shape)}")
            if not torch.isfinite(value).all():
                raise ValueError(f"{name} is not finite")
            if name.endswith("_std") and (value <= 0.0).any():
                raise ValueError(f"{name} must be positive, smallest is {value.min().item():g}")
            if self.config.residual and name in ("psi_mean", "q_mean"):
                skin = torch.eye(3).flatten() if name == "psi_mean" else torch.zeros(3)
                if not torch.equal(value.cpu(), skin):
                    raise ValueError(f"{name} of a residual network stays {skin.tolist()}, so that zero means skin")
        for name, value in statistics.items():
            getattr(self, name).copy_(torch.as_tensor(value, dtype=torch.float32))

    def parameter_count(self) -> int:
        """Number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())

    def save(self, path: str | os.PathLike[str], *, dtype: torch.dtype | None = None) -> None:
        """Writes a checkpoint; see `checkpoint.save`."""
        checkpoint.save(self, path, dtype=dtype)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str | None = None) -> GarmentNetwork:
        """Reads a checkpoint; see `checkpoint.load`."""
        return checkpoint.load(path, device=device)
