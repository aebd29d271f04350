"""The training loop.

    warpgarment train --data sequences --out out/run --time-limit 60              # one CPU core, an hour
    warpgarment train --data sequences --out out/run --time-limit 60 --resume     # goes on where it stopped
    warpgarment train --data sequences --out out/run --steps 200000 --network base \\
        --precision bfloat16 --compile                                            # one GPU, a number of steps
    warpgarment train --data sequences --out out/base --network base --init small --grow ...  # starts as small
    torchrun --standalone --nproc-per-node 8 -m warpgarment train ...             # eight GPUs share the same batches

The out folder gets `network.safetensors` (averaged weights), `best.safetensors` (averaged weights with the least error
in validation rollouts), `state.safetensors` (everything needed to resume), `log.jsonl`, `config.json`, and TensorBoard
events if TensorBoard is installed. The schedule is a function of the step if `steps` is given, otherwise of the time.
With `steps`, a run on one CPU that was stopped or killed and then resumed has the same losses as an uninterrupted one,
bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterable
from pathlib import Path

import torch

from warpgarment.errors import UsageError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.leftovers import remove_leftovers
from warpgarment.io.disk.outputs import check_space, check_writable
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import architecture, build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.network import GarmentNetwork
from warpgarment.training.distributed import Group, GroupError
from warpgarment.training.samples.loader import Plan
from warpgarment.training.samples.outfits import OutfitBuilder
from warpgarment.training.samples.single_step import SampleBuilder

from .config import TrainConfig
from .log import say
from .objective import CompileFailed
from .rate import spelt
from .run import STATE, NonFiniteLoss, Run
from .training_set import NoTrainingData, load_sequences, load_validation, report

__all__ = ["CompileFailed", "GroupError", "NoTrainingData", "NonFiniteLoss", "Run", "TrainConfig", "train"]


WITHOUT_WEIGHTS = ("physics", "physics_length")  # settings that a trained network can be given
KEPT = 10  # times the weights: those of two networks, and a state of four sets, written beside the old one


def train(config: TrainConfig) -> Path:
    """Trains a network, together with the other processes if torchrun started several.

    Returns:
        File of the network with the least error in validation rollouts; of the final one without validation.

    Raises:
        NoTrainingData: No sequence in the data folder is usable.
        NonFiniteLoss: The loss or gradient is not finite any more.
        GrowthError: `init` cannot be grown to the shape wanted.
        CompileFailed: `compile` is set, and compilation failed.
        UsageError: An override is none, or contradicts `init`.
        CheckpointError: `init` or the state to resume from cannot be read or does not fit.
        GroupError: The processes cannot work together.
        OutputError: `out` cannot be written to, or the disk has no room for the networks and the state.
    """
    began = time.monotonic()
    check_writable(Path(config.out), folder=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    with Group(config.device) as group:
        return _train(config, group, began)


def _override(network: GarmentNetwork, wanted: NetworkConfig, names: Iterable[str]) -> None:
    """Gives a trained network those of the overrides that no weight depends on.

    Raises:
        UsageError: It has another value of one that weights depend on.
    """
    free = {name: getattr(wanted, name) for name in names if name in WITHOUT_WEIGHTS}
    network.config = dataclasses.replace(network.config, **free)
    for name in names:
        has, wants = getattr(network.config, name, None), getattr(wanted, name)
        more = name == "outdoor" and set(wants) <= set(has or ())  # channels are added to those that there are
        if has != wants and not more and name != "dropout":  # of which the default of the overrides speaks, too
            raise UsageError(
                f"overrides: {name}={wants}, but the network from init has {has}, and its weights depend on it. Leave "
                f"{name} out, or start without init"
            )


def _train(config: TrainConfig, group: Group, began: float) -> Path:
    group.part(config.batch_size)
    torch.manual_seed(config.seed)
    wanted = config.network_config()
    if config.init is not None:
        given = checkpoint.load(checkpoint.find(config.init), device=group.device)
        network = architecture(wanted.architecture).start_from(given, wanted, grow=config.grow)
        _override(network, wanted, config.overridden)
    else:
        network = build_network(wanted).to(group.device)
    check_space(Path(config.out), KEPT * 4 * network.parameter_count())
    skipped: dict[str, str] = {}
    try:
        sequences = load_sequences(config, network.config, skipped, group)
        validation = load_validation(config, skipped, network.config.fps) if group.first else []
        builder = make_builder(config, network, sequences)
        newest = [s.pieces.newest(config.unroll.steps) for s in sequences]
        plan = Plan([len(s.faces) for s in sequences], newest, config.batch_size, config.seed)
        run = Run(config, network, plan, builder, validation, began, group)
        if group.first:
            _prepare(config)
            samples = sum(map(len, newest))
            say(
                f"{len(sequences)} sequences, {samples:,} samples, {plan.batches} batches an epoch, {len(skipped)} "
                f"skipped; {network.parameter_count():,} parameters on "
                + (f"{group.size} devices like " if group.size > 1 else "")
                + str(group.device)
            )
        run.start(Path(config.out) / STATE)
        try:
            run.loop()
        except KeyboardInterrupt:
            if group.size == 1:  # other processes may be at another step; the last saved state is kept
                run.save()
            raise
        best = run.finish()
    finally:
        if skipped and group.first:
            say(report(skipped))
    if group.first:
        say(f"step {run.step:,}: {best}" + (f", {spelt(run.figures)}" if run.figures else ""))
    return best


def make_builder(config: TrainConfig, network: GarmentNetwork, sequences: list) -> SampleBuilder | OutfitBuilder:
    """The builder of single-step samples, or of outfits for a network that predicts positions.

    Raises:
        ValueError: The network predicts positions, and its kind does not say so.
    """
    if architecture(network.config.architecture).positions:
        less = config.outfit.noise
        noise = dataclasses.replace(
            config.noise, position=less * config.noise.position, offset=less * config.noise.offset
        )
        ahead, steps, mirror = config.outfit.rollout, config.unroll.steps, config.augmentation.mirror
        return OutfitBuilder(sequences, network, noise, ahead, steps, mirror, config.outfit.to_skin)
    if type(network).forward_normalised is GarmentNetwork.forward_normalised:
        raise ValueError(
            f"a {type(network).__name__} has no forward_normalised, so it is not trained on steps of faces. If it "
            f"predicts positions, set positions = True in its Architecture ({network.config.architecture!r})"
        )
    return SampleBuilder(sequences, network.config, config.noise, config.augmentation)


def _prepare(config: TrainConfig) -> None:
    """Makes the out folder, and removes incomplete files of a run that was killed."""
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    remove_leftovers(out, old=0.0)
    with atomic_file(out / "config.json") as temporary:
        temporary.write_text(json.dumps(dataclasses.asdict(config), default=str, indent=2), "utf-8")
