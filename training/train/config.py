"""The settings of a training run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from warpgarment.errors import UsageError
from warpgarment.nn.architecture import architecture, preset
from warpgarment.nn.config import NetworkConfig
from warpgarment.training.samples.augmentation import Augmentation
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.pushforward import PushforwardConfig

from .cloth_losses import ClothLossConfig
from .losses import LossConfig
from .position_objective import PositionConfig
from .unrolled_objective import UnrollConfig


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Attributes:
        data: Folder of sequences.
        out: Folder for all output of the run.
        network: Named shape of the network; "fast" is a network of patches of cloth, "layersnet" one for layered
            outfits in the wind ("layersnet-paper" in its published form), the others have a token for every face.
        overrides: Changes to that shape, `name=value`, for example `layers=6 geodesic_radius=0.3 residual=false`.
        init: Checkpoint to start from instead of random weights; its shape and statistics are kept. A file, a folder,
            or the name of a network that ships. A network of patches can also start from one of faces with the same
            widths. Outdoor channels among the overrides (`outdoor=density,...,wind`) are added to it, without weight.
        grow: First grow `init` to the shape of `network` and `overrides`; its predictions stay the same.
        steps: Number of training steps; None for as many as `time_limit` allows.
        time_limit: Time after which the run stops cleanly, start and validation included [minutes]; None for no limit.
        batch_size: Number of samples per step in all processes together, which share them evenly.
        splits: Number of subsets (n_s) into which each garment's faces are split at first; one of them makes a sample.
        split_share: Share of the schedule after which garments are no longer split, from 0 to 1.
        lr: Peak learning rate.
        warmup: Share of the schedule in which the learning rate rises; then it falls as a cosine to `lr_end` times the
            peak.
        lr_end: Learning rate at the end, as a share of the peak.
        weight_decay: Weight decay of AdamW; 0 is Adam.
        clip: Largest norm of the gradient.
        average: Decay of the moving average of the weights per step.
        precision: "bfloat16" runs the transformer in mixed precision; weights, statistics and losses stay float32.
        compile: Compile the network with torch.compile (needs Triton on a GPU, a C++ compiler on a CPU).
        validate_every: Number of steps between validations.
        validate_frames: Length of the validation rollouts [frames], which start cold.
        validate_sequences: Number of validation rollouts.
        save_every: Number of steps between saved states.
        log_every: Number of steps of which a line of `log.jsonl` is the mean; on a GPU, losses are read and checked at
            the same steps.
        statistics_batches: Number of batches from which means and deviations of the data are computed.
        max_sequences: Largest number of training sequences; None for all.
        seed: Seed of all random numbers.
        threads: Number of CPU threads of torch; None for torch's default.
        ahead: Number of batches built ahead in a thread; 0 builds them when they are needed.
        cache: Folder for precomputed body interactions; None for a folder beside the data.
        device: "cpu" or "cuda"; None for a GPU if there is one.
        resume: Continue from the state in `out`, if there is one.
    """

    data: Path
    out: Path
    network: Literal["small", "base", "fast", "layersnet", "layersnet-paper"] = "small"
    overrides: tuple[str, ...] = ("dropout=0.0",)
    init: Path | None = None
    grow: bool = False
    steps: int | None = None
    time_limit: float | None = None
    batch_size: int = 16
    splits: int = 4
    split_share: float = 0.9
    lr: float = 1e-3
    warmup: float = 0.02
    lr_end: float = 0.01
    weight_decay: float = 0.0
    clip: float = 1.0
    average: float = 0.998
    precision: Literal["float32", "bfloat16"] = "float32"
    compile: bool = False
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    pushforward: PushforwardConfig = field(default_factory=PushforwardConfig)
    unroll: UnrollConfig = field(default_factory=UnrollConfig)
    cloth: ClothLossConfig = field(default_factory=ClothLossConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    outfit: PositionConfig = field(default_factory=PositionConfig)
    validate_every: int = 500
    validate_frames: int = 60
    validate_sequences: int = 3
    save_every: int = 500
    log_every: int = 20
    statistics_batches: int = 24
    max_sequences: int | None = None
    seed: int = 0
    threads: int | None = None
    ahead: int = 3
    cache: Path | None = None
    device: str | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        if self.steps is None and self.time_limit is None:
            raise ValueError("give steps or time_limit (minutes), which define the end of the schedule")
        if self.grow and self.init is None:
            raise ValueError("grow needs init, the network to grow")
        for name in ("batch_size", "splits", "validate_every", "save_every", "log_every", "statistics_batches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

        if self.compile and architecture(self.network_config().architecture).positions:
            raise ValueError("networks that predict positions are not compiled: leave out compile")
        if self.unroll.steps > 1 and self.compile:
            raise ValueError("unrolled training is not compiled: leave out compile, or set unroll.steps to 1")
        if self.cloth.terms and (self.unroll.steps == 1 or architecture(self.network_config().architecture).positions):
            raise ValueError(
                f"cloth.{self.cloth.terms[0]} is a loss of unrolled training of networks of faces and patches: set "
                "unroll.steps to 2 or more"
            )
        if self.unroll.steps > 1 and self.augmentation.scale:
            raise ValueError("unrolled samples keep their size: set augmentation.scale to 0, or unroll.steps to 1")

    @property
    def overridden(self) -> tuple[str, ...]:
        """Names of the overrides."""
        return tuple(text.partition("=")[0] for text in self.overrides)

    def network_config(self) -> NetworkConfig:
        """The network's shape with the overrides applied."""
        named = preset(self.network)
        texts = dict(text.partition("=")[::2] for text in self.overrides)
        kind = architecture(texts.get("architecture", named.architecture)).config
        defaults = {field.name: field.default for field in dataclasses.fields(kind)}
        values = {name: value for name, value in vars(named).items() if name in defaults}
        for name, text in texts.items():
            if name not in defaults:
                raise UsageError(f"no network setting {name!r}; there are {', '.join(defaults)}")
            values[name] = _value(name, text, type(defaults[name]))
        try:
            return kind(**values)
        except ValueError as error:
            raise UsageError(f"overrides: {error}") from error


def _value(name: str, text: str, kind: type) -> Any:
    """Converts the text of an override to the type of its setting."""
    if kind is tuple:
        return tuple(part for part in text.split(",") if part)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise UsageError(f"{name} must be true or false, got {text!r}")
        return text.lower() == "true"
    try:
        return kind(text)
    except ValueError as error:
        what = {int: "a whole number", float: "a number"}.get(kind, f"of type {kind.__name__}")
        raise UsageError(
            f"{name} must be {what}, got {text!r}. Overrides are NAME=VALUE, with spaces between."
        ) from error
