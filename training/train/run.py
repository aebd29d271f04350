"""One training run: its loop, schedule, validation and saved state."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from warpgarment.io.npz import write_npz
from warpgarment.kernels.threads import torch_on_one
from warpgarment.metrics import mean_vertex_error
from warpgarment.nn import checkpoint
from warpgarment.nn.faces.grow import untrained
from warpgarment.nn.network import GarmentNetwork
from warpgarment.training.distributed import Group
from warpgarment.training.rollouts import predict
from warpgarment.training.samples.drawing import Builder
from warpgarment.training.samples.loader import Loader, Plan
from warpgarment.training.samples.outfits import OutfitBatch, OutfitBuilder
from warpgarment.training.samples.pushforward import Pool
from warpgarment.training.samples.single_step import Batch, SampleBuilder
from warpgarment.training.samples.statistics import outdoor_statistics, position_statistics, statistics
from warpgarment.training.samples.unrolled import UnrolledBatch, UnrolledBuilder

from . import state as training_state
from .config import TrainConfig
from .log import RunLog, json_number
from .objective import Objective, Trainer
from .position_objective import PositionObjective
from .rate import Rate, spelt
from .unrolled_objective import UnrolledObjective

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator

STATE = "state.safetensors"
SHARED_OUT = "All machines must see the same out folder."


class NonFiniteLoss(ArithmeticError):
    """The loss or gradient is not finite; the message names the file that holds the batch."""


class Run:
    """One training run.

    Losses are read from the device at every step on a CPU, every `log_every` steps on a GPU, and before a state is
    saved, so that no state is saved after a loss that was not finite.

    Args:
        config: Settings of the run.
        network: The network to train.
        plan: Samples of each batch.
        builder: Builder of single-step samples, or of outfits for a network that predicts positions.
        validation: Sequences for validation, from `load_validation`.
        began: Time at which the run started, of `time.monotonic` [s].
        group: The processes that train together.
    """

    def __init__(
        self,
        config: TrainConfig,
        network: GarmentNetwork,
        plan: Plan,
        builder: SampleBuilder | OutfitBuilder,
        validation: list,
        began: float,
        group: Group,
    ) -> None:
        self.config, self.network, self.validation, self.began = config, network, validation, began
        self.out, self.group, self.device = Path(config.out), group, group.device
        self.builder, self.pool, part = builder, Pool(), group.part(config.batch_size)
        steps, passes, ahead = config.unroll.steps, config.unroll.collision_passes, config.ahead
        chosen: Builder[Any] = builder
        self.positions = isinstance(builder, OutfitBuilder)
        if isinstance(builder, OutfitBuilder):
            ahead = 0  # the search trees of a layout must stay in one thread
        elif steps > 1:
            chosen = UnrolledBuilder(builder.sequences, network, config.noise, config.augmentation, steps, passes)
            ahead = 0  # the solvers of a scene must stay in one thread
        self.loader = Loader(chosen, plan, self.pool, config.pushforward.share, self.splits, ahead, part)
        self.average = training_state.Average(network, config.average)
        self.optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.lr, weight_decay=config.weight_decay, fused=True
        )
        self.rate = Rate(self.device, config.precision, group.size)
        self.read_every = 1 if self.device.type == "cpu" else config.log_every
        self.step, self.earlier, self.now, self.best = 0, 0.0, 0.0, math.inf
        self.whole_from = math.inf  # the step from which garments are no longer split
        self.unread: list[torch.Tensor] = []  # figures of steps, still on the device
        self.recent: list[list[float]] = []  # figures read since the last line of the log
        self.figures: dict[str, float] = {}  # figures of the rate in the last line of the log
        self._saved: tuple[int, float] | None = None

    # The schedule, which is the same in all processes

    def elapsed(self) -> float:
        """Seconds of training, including those before a resume."""
        return self.earlier + time.monotonic() - self.began

    def look_at_clock(self) -> None:
        """Takes the elapsed time from the first process, so that all processes follow the same schedule."""
        self.now = self.elapsed()
        if self.config.time_limit is not None:
            self.now = self.group.from_first(self.now)
        if self.whole_from == math.inf and self.progress(self.step) >= self.config.split_share:
            self.whole_from = self.step + self.config.ahead + 2  # earlier batches may be built already

    def progress(self, step: int) -> float:
        """Progress of the schedule from 0 to 1: by steps if their number is given, otherwise by time."""
        if self.config.steps is not None:
            return min(step / self.config.steps, 1.0)
        assert self.config.time_limit is not None  # one of the two is given, see `TrainConfig`
        return min(self.now / (60.0 * self.config.time_limit), 1.0)

    def splits(self, step: int) -> int:
        """Number of subsets into which faces are split at a step."""
        if self.config.steps is not None:
            return self.config.splits if self.progress(step) < self.config.split_share else 1
        return self.config.splits if step < self.whole_from else 1

    def learning_rate(self, progress: float) -> float:
        """Learning rate at a progress from 0 to 1: a linear rise, then a cosine."""
        config = self.config
        if progress < config.warmup:
            return config.lr * max(progress / config.warmup, 1e-3)
        fall = (progress - config.warmup) / (1.0 - config.warmup)
        return config.lr * (config.lr_end + (1.0 - config.lr_end) * 0.5 * (1.0 + math.cos(math.pi * fall)))

    def over(self) -> bool:
        """Whether the run has reached its number of steps or its time limit."""
        limit = self.config.time_limit
        late = limit is not None and self.now >= 60.0 * limit
        return late or (self.config.steps is not None and self.step >= self.config.steps)

    # Start, loop, end

    def start(self, path: Path) -> None:
        """Resumes from the state at `path`, or computes the statistics of a new run."""
        config, group = self.config, self.group
        resumed = config.resume and path.exists()
        if resumed:
            extra, progress = training_state.load(path, self.network, self.average, self.optimizer)
            self.pool.restore(extra)
            self.step, self.earlier, self.best = progress["step"], progress["elapsed"], progress["best"]
            self.pool.step, self.recent = progress["pool_step"], progress.get("recent", [])
        elif group.first and (config.init is None or untrained(self.network)):
            steps = range(2**30, 2**30 + config.statistics_batches)  # none of the run's own
            single: Loader[Any] = Loader(
                self.builder, self.loader.plan, Pool(), 0.0, self.splits
            )  # single steps in any case
            batches = (single.build(step, splits=config.splits, part=slice(None)) for step in steps)
            measured = position_statistics if self.positions else statistics
            if config.init is not None:  # it keeps its own; only channels that were just added have none yet
                measured = outdoor_statistics
            self.network.set_statistics(measured(batches, self.network))
        group.agree("the step to resume from", self.step, SHARED_OUT)
        if not resumed:
            group.same(self.network.state_dict().values())
            self.average.update(self.network)
        self.log = RunLog(self.out if group.first else None, self.step if resumed else None)
        settings = (self.network, config.loss, config.noise.features, config.precision)
        objective: Objective | UnrolledObjective | PositionObjective
        if self.positions:
            objective = PositionObjective(self.network, config.outfit, config.precision)
        else:
            unrolled = config.unroll.steps > 1
            objective = UnrolledObjective(*settings, config.unroll, config.cloth) if unrolled else Objective(*settings)
        self.objective = objective
        self.names = (*objective.figures, "gradient_norm")
        self.recent = [row for row in self.recent if len(row) == len(self.names)]  # others are of another objective
        self.trainer = Trainer(objective, group, config.compile)
        self.look_at_clock()
        self.whole_from = self.step if self.progress(self.step) >= config.split_share else math.inf

    def loop(self) -> None:
        """Trains until the run is over."""
        shares = self.network.shares_threads and self.device.type == "cpu"
        with torch_on_one() if shares else contextlib.nullcontext():
            self._loop()

    def _loop(self) -> None:
        config = self.config
        last = config.steps if config.steps is not None else 2**31
        hidden = not self.group.first
        bar = tqdm(total=config.steps, initial=self.step, unit="step", mininterval=5.0, disable=hidden)
        self.network.train()
        settled = False
        while not self.over():
            self.refresh_pool()
            until = min(last, *(n * (self.step // n + 1) for n in self._periods()))
            self.rate.go()
            for batch in self.loader.batches(self.step, until):
                self.update(batch)
                del batch  # the next one may take over its scene
                self.step += 1
                if not settled:  # all is loaded that later collections of garbage need not look at
                    gc.freeze()
                    settled = True
                bar.update()
                if self.step % self.read_every == 0:
                    self.read_losses()
                if self.step % config.log_every == 0:
                    self.log_training(bar)
                self.look_at_clock()
                if self.over():
                    break
            self.read_losses()
            self.rate.stop()
            if self._due(config.validate_every) and not self.over():
                self.validate()
            if self._due(config.save_every):
                self.save()
            self.look_at_clock()
        bar.close()

    def update(self, batch: Batch | UnrolledBatch | OutfitBatch) -> None:
        """One step of the optimiser; the host does not wait for the device."""
        config, network = self.config, self.network
        torch.manual_seed(config.seed * 1_000_003 + self.step + 2**40 * self.group.rank)  # dropout and feature noise
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate(self.progress(self.step))
        self.optimizer.zero_grad(set_to_none=True)
        if isinstance(self.objective, PositionObjective):
            self.objective.progress = self.progress(self.step)
        losses = self.trainer.backward(batch)
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip, foreach=True)
        self.optimizer.step()
        self.average.update(network)
        self.unread.append(torch.cat([losses, norm.detach()[None]]))
        self.rate.count(*batch.work(network.config))

    def read_losses(self) -> None:
        """Reads the figures of the steps since the last call; stops the run if one is not finite."""
        if not self.unread:
            return
        rows = self.group.mean(torch.stack(self.unread)).tolist()
        first = self.step - len(rows)
        self.unread.clear()
        for number, row in enumerate(rows):
            if not all(map(math.isfinite, row)):
                self._give_up(first + number)
            self.recent.append(row)

    def refresh_pool(self) -> None:
        """Fills the pool with rollouts of the averaged network, if that is due at this step."""
        settings = self.config.pushforward
        if not settings.share or self.step == 0 or self.step % settings.every or self.pool.step == self.step:
            return
        rng = np.random.default_rng((self.config.seed, 2, self.step))
        error = self.pool.refresh(self._simulator(), self.builder.sequences, settings, rng, self.group)
        self.pool.step = self.step
        self._note(pool_rollouts=len(self.pool.rollouts), pool_error_cm=100.0 * error)

    def validate(self) -> None:
        """Runs short rollouts from cold starts; saves the averaged network if it is the best so far."""
        if not self.validation or not self.group.first:
            return
        simulator, errors = self._simulator(), []
        for sequence, body, frames in self.validation:
            predicted = predict(simulator, sequence, 0, frames, cold=True, body=body)
            truth = np.array(sequence.vertices[1 : frames + 1])
            finite = np.isfinite(predicted).all()
            errors.append(float(mean_vertex_error(predicted, truth)) if finite else math.inf)
        error = float(np.mean(errors))
        self._note(rollout_error_cm=error, each=[round(e, 3) for e in errors])
        if error < self.best:
            self.best = error
            self._save_network("best.safetensors")
            self.save()  # so that a run that is killed now keeps the new best error

    def save(self) -> None:
        """Saves the state and the averaged network."""
        self.read_losses()
        if not self.group.first or self._saved == (self.step, self.best):
            return
        progress: dict[str, Any] = {"step": self.step, "elapsed": self.elapsed(), "best": self.best}
        progress |= {"pool_step": self.pool.step, "recent": self.recent}
        training_state.save(self.out / STATE, self.network, self.average, self.optimizer, self.pool.tensors(), progress)
        self._save_network("network.safetensors")
        self._saved = (self.step, self.best)

    def finish(self) -> Path:
        """Saves and validates the final network; returns the file of the best network."""
        self.save()
        self.validate()
        self.save()
        self.log.close()
        best = self.group.from_first(self.best)
        return self.out / ("best.safetensors" if math.isfinite(best) else "network.safetensors")

    # Helpers

    def _periods(self) -> list[int]:
        config = self.config
        periods = [config.validate_every, config.save_every]
        return periods + ([config.pushforward.every] if config.pushforward.share else [])

    def _due(self, period: int) -> bool:
        return self.step % period == 0

    def _simulator(self) -> Simulator:
        from warpgarment.sim.simulator import Simulator

        return Simulator(self.average.network, self.device)

    def _save_network(self, name: str) -> None:
        hours = round(self.elapsed() / 3600, 3)
        sequences = self.builder.sequences
        data = f"{Path(self.config.data).name}, {len(sequences)} sequences, {sum(s.count for s in sequences):,} samples"
        notes = {"steps": self.step, "hours": hours, "rollout_error_cm": json_number(self.best), "data": data}
        notes["training"] = json.loads(json.dumps(dataclasses.asdict(self.config), default=str))
        for key in ("data", "out", "cache", "init"):
            notes["training"].pop(key)
        checkpoint.save(self.average.network, self.out / name, notes=notes)

    def log_training(self, bar: tqdm) -> None:
        """Writes a line of the log: means of the figures since the last line, and the rate."""
        self.read_losses()
        means = map(float, np.mean(self.recent, axis=0))
        self.recent.clear()
        self.figures = self.rate.take()
        entry = dict(zip(self.names, means, strict=True))
        left = (
            "" if self.config.time_limit is None else f", {self.config.time_limit - self.elapsed() / 60:.0f} min left"
        )
        bar.set_postfix_str(f"loss {entry['loss']:.3f}, {spelt(self.figures)}{left}", refresh=False)
        entry["lr"] = self.optimizer.param_groups[0]["lr"]
        self.log.write(self.step, self.elapsed(), entry | self.figures)

    def _note(self, **values: Any) -> None:
        self.log.write(self.step, self.elapsed(), values, aloud=True)

    def _give_up(self, step: int) -> None:
        """Builds the batch of a step again from the number of the step, writes it, and raises NonFiniteLoss."""
        path = self.out / f"not_finite_{step}.npz"
        if self.group.first:
            batch = self.loader.build(step, part=slice(None))
            names, frames = zip(*batch.ids, strict=True)
            write_npz(path, {"sequence": np.array(names), "frame": np.array(frames), **batch.arrays()})
        self.group.wait()
        raise NonFiniteLoss(
            f"the loss or gradient of step {step} is not finite; its batch is in {path}. Look for features that are "
            "not finite there; if there are none, lower lr and go on from the last saved state with resume."
        )
