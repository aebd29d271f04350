"""The training loop.

    warpgarment train --data sequences --out out/run --time-limit 60              # one CPU core, an hour
    warpgarment train --data sequences --out out/run --steps 20000 --device cuda  # one GPU, so many steps
    warpgarment train --data sequences --out out/run --time-limit 60 --resume     # goes on where it stopped

Writes into the out folder: `network.safetensors` (averaged weights, ships), `best.safetensors` (the same at the best
validation rollout), `state.safetensors` (everything needed to resume), `log.jsonl`, `config.json`, and TensorBoard
events where installed. The schedule is a function of the step where `steps` is given, and of the time where only
`time_limit` is. With `steps`, a resumed run on one CPU gives the losses of an uninterrupted one, bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm

from warpgarment import checkpoint
from warpgarment.kernels.features import FEATURES
from warpgarment.metrics import mean_vertex_error
from warpgarment.network import ManifoldAwareTransformer, NetworkConfig
from warpgarment.training import state as training_state
from warpgarment.training.dataset import Sequence, list_sequences
from warpgarment.training.interactions import default_cache
from warpgarment.training.loader import Loader, Plan
from warpgarment.training.losses import LossConfig, loss
from warpgarment.training.noise import NoiseConfig
from warpgarment.training.pushforward import Pool, PushforwardConfig
from warpgarment.training.rollouts import predict
from warpgarment.training.samples import Augmentation, Batch, SampleBuilder, SequenceData


class NoTrainingData(ValueError):
    """No sequence can be trained on; the message counts the reasons."""


class NonFiniteLoss(ArithmeticError):
    """The loss is not a number any more; the message names the file that holds the batch."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run.

    Attributes:
        data: Folder of sequences.
        out: Folder for everything that is written.
        network: Shape to start from.
        overrides: Changes to it, `name=value`, for example `layers=6 geodesic_radius=0.3 residual=false`.
        init: Checkpoint to start from instead of random weights (its shape and statistics are kept).
        steps: Number of steps; None: as many as `time_limit` allows.
        time_limit: Minutes after which the run stops cleanly, everything counted; None: no limit.
        batch_size: Samples per step.
        splits: Subsets each garment's faces are split into at first (n_s); one of them makes a sample.
        split_share: Share of the schedule after which garments are no longer split.
        lr: Peak learning rate.
        warmup: Share of the schedule that it rises over; after that it falls as a cosine to `lr_end` times the peak.
        lr_end: See `warmup`.
        weight_decay: Of AdamW; 0 is Adam.
        clip: Largest norm of the gradient.
        average: Decay of the weight average.
        precision: "bfloat16" runs the transformer in mixed precision.
        validate_every: Steps between validation rollouts.
        validate_frames: Their length, from a cold start.
        validate_sequences: Their number.
        save_every: Steps between saved states.
        log_every: Steps that a line of `log.jsonl` is the mean of.
        statistics_batches: Batches that statistics are taken from.
        max_sequences: Train on this many sequences only.
        seed: Of everything random.
        threads: CPU threads of torch; None leaves torch's own choice.
        ahead: Batches built ahead in a thread; 0: none, in line.
        cache: Folder for body interactions; None: beside the data.
        device: "cpu", "cuda"; None: a GPU where there is one.
        resume: Go on from the state in `out`, if there is one.
    """

    data: Path
    out: Path
    network: Literal["small", "base"] = "small"
    overrides: tuple[str, ...] = ("dropout=0.0",)
    init: Path | None = None
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
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    augmentation: Augmentation = field(default_factory=Augmentation)
    pushforward: PushforwardConfig = field(default_factory=PushforwardConfig)
    loss: LossConfig = field(default_factory=LossConfig)
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
            raise ValueError("give steps or time_limit (minutes), so that the schedule knows its end")

    def network_config(self) -> NetworkConfig:
        """The network's shape with the overrides applied."""
        kinds = {f.name: type(f.default) for f in dataclasses.fields(NetworkConfig)}
        changes = {}
        for text in self.overrides:
            name, _, value = text.partition("=")
            if name not in kinds:
                raise ValueError(f"no network setting {name!r}; there are {', '.join(kinds)}")
            kind = kinds[name]
            if kind is bool and value.lower() not in ("true", "false"):
                raise ValueError(f"{name} must be true or false, got {value!r}")
            changes[name] = value.lower() == "true" if kind is bool else kind(value)
        return getattr(NetworkConfig, self.network)(**changes)


def train(config: TrainConfig) -> Path:
    """Trains a network.

    Returns:
        The file of the network that did best in the validation rollouts, or the final one where there were none.

    Raises:
        NoTrainingData: Nothing in the data folder is usable.
        NonFiniteLoss: Training diverged.
        CheckpointError: The state to resume from does not fit.
    """
    began = time.monotonic()
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    device = torch.device(config.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    torch.manual_seed(config.seed)
    if config.init is not None:
        network = checkpoint.load(config.init, device=device)
    else:
        network = ManifoldAwareTransformer(config.network_config()).to(device)

    skipped: dict[str, str] = {}
    sequences = load_sequences(config, network.config, device, skipped)
    validation = load_validation(config, network.config, skipped)
    builder = SampleBuilder(sequences, network.config, config.noise, config.augmentation)
    plan = Plan([len(s.faces) for s in sequences], [s.count for s in sequences], config.batch_size, config.seed)
    run = Run(config, network, plan, builder, validation, began)
    tqdm.write(
        f"{len(sequences)} sequences, {sum(s.count for s in sequences):,} samples, {plan.batches} batches an epoch, "
        f"{len(skipped)} skipped; {network.parameter_count():,} parameters on {device}"
    )
    (out / "config.json").write_text(json.dumps(dataclasses.asdict(config), default=str, indent=2))
    run.start(out / "state.safetensors")
    try:
        run.loop()
    except KeyboardInterrupt:
        run.save()
        raise
    finally:
        for name, reason in skipped.items():
            tqdm.write(f"skipped {name}: {reason}")
    return run.finish()


def load_sequences(config: TrainConfig, network: NetworkConfig, device, skipped: dict[str, str]) -> list[SequenceData]:
    """Training sequences with their cached interactions; what cannot be used goes to `skipped` with its reason."""
    cache = Path(config.cache) if config.cache else default_cache(Path(config.data))
    folders = list_sequences(Path(config.data), split="train")[: config.max_sequences]
    sequences = []
    for folder in tqdm(folders, desc="sequences", unit="", leave=False):
        try:
            sequences.append(SequenceData(Sequence.load(folder), folder, cache, network, device))
        except (ValueError, OSError, KeyError, IndexError) as error:
            skipped[Path(folder).name] = f"{type(error).__name__}: {error}"
    if not sequences:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        found = f"{len(folders)} training sequences, none usable ({reasons})" if folders else "no training sequences"
        raise NoTrainingData(f"{config.data}: {found}")
    return sequences


def load_validation(config: TrainConfig, network: NetworkConfig, skipped: dict[str, str]) -> list:
    """A few validation sequences, spread over the list, with their bodies: (sequence, body, frames to predict)."""
    folders = list_sequences(Path(config.data), split="validation")
    wanted = min(config.validate_sequences, len(folders))
    chosen = [folders[(i * len(folders)) // wanted] for i in range(wanted)]
    found = []
    for folder in chosen:
        try:
            sequence = Sequence.load(folder)
            body = sequence.body()
            frames = min(len(sequence.vertices), body.frames, config.validate_frames + 1)
            if frames < 2 or not np.isfinite(np.asarray(sequence.vertices[:frames])).all():
                raise ValueError("too short, or not finite")
            found.append((sequence, body, frames - 1))
        except (ValueError, OSError, KeyError, IndexError) as error:
            skipped[Path(folder).name] = f"{type(error).__name__}: {error}"
    return found


class Run:
    """One training run: what changes from step to step."""

    def __init__(
        self, config: TrainConfig, network, plan: Plan, builder: SampleBuilder, validation: list, began: float
    ) -> None:
        self.config, self.network, self.validation, self.began = config, network, validation, began
        self.out = Path(config.out)
        self.device = next(network.parameters()).device
        self.builder, self.pool = builder, Pool()
        self.loader = Loader(builder, plan, self.pool, config.pushforward.share, self.splits, config.ahead)
        self.average = training_state.Average(network, config.average)
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.lr, weight_decay=config.weight_decay, fused=True
        )
        self.step, self.earlier, self.best = 0, 0.0, math.inf
        self.recent: list[list[float]] = []
        self.writer = _tensorboard(self.out)

    # The schedule

    def elapsed(self) -> float:
        """Seconds of training, those before a resume included."""
        return self.earlier + time.monotonic() - self.began

    def progress(self, step: int) -> float:
        """How far the schedule is, 0..1: by steps where their number is given, else by time."""
        if self.config.steps is not None:
            return min(step / self.config.steps, 1.0)
        return min(self.elapsed() / (60.0 * self.config.time_limit), 1.0)

    def splits(self, step: int) -> int:
        """Subsets of faces at a step."""
        return self.config.splits if self.progress(step) < self.config.split_share else 1

    def learning_rate(self, progress: float) -> float:
        """Linear warm-up, then a cosine."""
        config = self.config
        if progress < config.warmup:
            return config.lr * max(progress / config.warmup, 1e-3)
        fall = (progress - config.warmup) / (1.0 - config.warmup)
        return config.lr * (config.lr_end + (1.0 - config.lr_end) * 0.5 * (1.0 + math.cos(math.pi * fall)))

    def over(self) -> bool:
        """Whether the run has had its steps or its time."""
        limit = self.config.time_limit
        late = limit is not None and self.elapsed() >= 60.0 * limit
        return late or (self.config.steps is not None and self.step >= self.config.steps)

    # Start, loop, end

    def start(self, path: Path) -> None:
        """Resumes, or takes the statistics of a new run."""
        if self.config.resume and path.exists():
            extra, progress = training_state.load(path, self.network, self.average, self.optimizer)
            self.pool.restore(extra)
            self.step, self.earlier, self.best = progress["step"], progress["elapsed"], progress["best"]
            self.pool.step = progress["pool_step"]
        else:
            (self.out / "log.jsonl").write_text("")
            if self.config.init is None:
                steps = range(2**30, 2**30 + self.config.statistics_batches)  # far from those of the run
                batches = (self.loader.build(step, splits=self.config.splits) for step in steps)
                self.network.set_statistics(statistics(batches, self.network))
                self.average.update(self.network)

    def loop(self) -> None:
        """Steps until the run is over."""
        config = self.config
        last = config.steps if config.steps is not None else 2**31
        bar = tqdm(total=config.steps, initial=self.step, unit="step", mininterval=5.0)
        self.network.train()
        while not self.over():
            self.refresh_pool(bar)
            until = min(last, *(n * (self.step // n + 1) for n in self._periods()))
            for batch in self.loader.batches(self.step, until):
                values = self.update(batch)
                self.step += 1
                bar.update()
                self.recent.append(values)
                if self.step % config.log_every == 0:
                    self._log_training(bar)
                if self.over():
                    break
            if self._due(config.validate_every) and not self.over():
                self.validate(bar)
            if self._due(config.save_every):
                self.save()
        bar.close()

    def update(self, batch: Batch) -> list[float]:
        """One step of the optimiser."""
        config, network = self.config, self.network
        torch.manual_seed(config.seed * 1_000_003 + self.step)  # dropout and feature noise
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.progress(self.step))
        x, v = network.encode(batch.features, batch.velocities)
        if config.noise.features:
            x = x + config.noise.features * torch.randn_like(x)
            v = v + config.noise.features * torch.randn_like(v)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=config.precision == "bfloat16"):
            predicted = network.forward_normalised(x, v, batch.weights, velocity_mask=batch.velocity_mask)
        losses = loss(predicted, network.normalise_targets(batch.target), network, config.loss, batch.velocity_mask)
        values = [float(part.detach()) for part in losses]
        if not math.isfinite(values[0]):
            self._give_up(batch)
        self.optimizer.zero_grad(set_to_none=True)
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip, foreach=True)
        self.optimizer.step()
        self.average.update(network)
        return values

    def refresh_pool(self, bar) -> None:
        """Fills the pool with rollouts of the averaged network, where that is due and has not been done."""
        settings = self.config.pushforward
        if not settings.share or self.step == 0 or self.step % settings.every or self.pool.step == self.step:
            return
        rng = np.random.default_rng((self.config.seed, 2, self.step))
        error = self.pool.refresh(self._simulator(), self.builder.sequences, settings, rng)
        self.pool.step = self.step
        self._log(bar, pool_rollouts=len(self.pool.rollouts), pool_error_cm=100.0 * error)

    def validate(self, bar) -> None:
        """Short rollouts from cold starts; keeps the averaged network where it is the best so far."""
        if not self.validation:
            return
        simulator, errors = self._simulator(), []
        for sequence, body, frames in self.validation:
            predicted = predict(simulator, sequence, 0, frames, cold=True, body=body)
            truth = np.array(sequence.vertices[1 : frames + 1])
            finite = np.isfinite(predicted).all()
            errors.append(float(mean_vertex_error(predicted, truth)) if finite else math.inf)
        error = float(np.mean(errors))
        self._log(bar, rollout_error_cm=error, each=[round(e, 3) for e in errors])
        if error < self.best:
            self.best = error
            self._save_network("best.safetensors")

    def save(self) -> None:
        """Saves the state and the averaged network."""
        progress = {"step": self.step, "elapsed": self.elapsed(), "best": self.best, "pool_step": self.pool.step}
        path = self.out / "state.safetensors"
        training_state.save(path, self.network, self.average, self.optimizer, self.pool.tensors(), progress)
        self._save_network("network.safetensors")

    def finish(self) -> Path:
        """Saves, validates the final network if it has not been, and says which network is best."""
        self.save()
        if self.validation:
            self.validate(tqdm(disable=True))
            self.save()
        if self.writer:
            self.writer.close()
        return self.out / ("best.safetensors" if math.isfinite(self.best) else "network.safetensors")

    # Small things

    def _periods(self) -> list[int]:
        config = self.config
        periods = [config.validate_every, config.save_every]
        return periods + ([config.pushforward.every] if config.pushforward.share else [])

    def _due(self, period: int) -> bool:
        return self.step % period == 0

    def _simulator(self):
        from warpgarment.simulator import Simulator

        return Simulator(self.average.network, self.device)

    def _save_network(self, name: str) -> None:
        hours = round(self.elapsed() / 3600, 3)
        notes = {"steps": self.step, "hours": hours, "rollout_error_cm": _json_number(self.best)}
        notes["training"] = json.loads(json.dumps(dataclasses.asdict(self.config), default=str))
        for key in ("data", "out", "cache", "init"):
            notes["training"].pop(key)
        checkpoint.save(self.average.network, self.out / name, notes=notes)

    def _log_training(self, bar) -> None:
        mean = np.mean(self.recent, axis=0)
        self.recent.clear()
        names = ("loss", "loss_deformation", "loss_singular_values", "loss_velocity")
        entry = {name: float(value) for name, value in zip(names, mean, strict=True)}
        bar.set_postfix({"loss": f"{mean[0]:.3f}"}, refresh=False)
        self._log(None, lr=self.optimizer.param_groups[0]["lr"], **entry)

    def _log(self, bar, **values) -> None:
        entry = {"step": self.step, "seconds": round(self.elapsed(), 1), **values}
        with (self.out / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps({k: _json_number(v) for k, v in entry.items()}) + "\n")
        if bar is not None:
            tqdm.write("  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in entry.items()))
        if self.writer:
            for name, value in values.items():
                if isinstance(value, float):
                    self.writer.add_scalar(name, value, self.step)

    def _give_up(self, batch: Batch) -> None:
        path = self.out / f"not_finite_{self.step}.npz"
        arrays = {"features": batch.features, "velocities": batch.velocities, "weights": batch.weights}
        arrays |= batch.target._asdict()
        names = np.array([name for name, _ in batch.ids])
        frames = np.array([frame for _, frame in batch.ids])
        np.savez(path, sequence=names, frame=frames, **{k: v.cpu().numpy() for k, v in arrays.items()})
        raise NonFiniteLoss(
            f"the loss of step {self.step} is not finite; its batch is in {path}. Look for features that are not "
            "finite there; if there are none, lower lr and go on from the last saved state with resume."
        )


def statistics(batches, network: ManifoldAwareTransformer) -> dict[str, torch.Tensor]:
    """Means and standard deviations of inputs and targets over some batches.

    Residual outputs keep the means that stand for skin; deviations have floors, so that numbers which hardly vary (a
    body at rest, a singular value that is always one) are not blown up.
    """
    samples: dict[str, list[torch.Tensor]] = {"feature": [], "velocity": [], "psi": [], "singular_value": [], "q": []}
    for batch in batches:
        samples["feature"].append(batch.features.reshape(-1, FEATURES))
        real = slice(None) if batch.velocity_mask is None else batch.velocity_mask
        samples["velocity"].append(batch.velocities[real].reshape(-1, 3))
        samples["psi"].append(batch.target.psi.reshape(-1, 9))
        samples["singular_value"].append(batch.target.singular_values.reshape(-1, 3))
        samples["q"].append(batch.target.velocity[real].reshape(-1, 3))
    floors = {"feature": 3e-3, "velocity": 1e-3, "psi": 1e-3, "singular_value": 1e-3, "q": 3e-4}
    found = {}
    for name, parts in samples.items():
        values = torch.cat(parts).double()
        mean = values.mean(dim=0)
        if network.config.residual and name in ("psi", "q"):
            mean = torch.eye(3, dtype=torch.float64).flatten() if name == "psi" else torch.zeros(3, dtype=torch.float64)
        deviation = (values - mean.to(values.device)).square().mean(dim=0).sqrt()
        found[f"{name}_mean"] = mean.float()
        found[f"{name}_std"] = deviation.clamp(min=floors[name]).float()
    return found


def _tensorboard(out: Path):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(out / "events"))


def _json_number(value):
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)
