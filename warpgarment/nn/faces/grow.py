"""Grows a network: makes a larger one that predicts the same, as a start for further training.

    warpgarment train --network base --overrides ... --init small.safetensors --grow ...

The network becomes wider and deeper and stays the same function (Chen, Goodfellow and Shlens 2016, "Net2Net"). For the
pre-norm encoder layers of attention.py:

- The residual stream is repeated: channel j of the large network holds channel j mod E of the small one. Layers that
  write to it have their rows repeated. Layers that read it divide each weight unevenly among the copies, so that the
  copies become different in training. Layer norm gives the same result, since mean and variance stay.
- New heads, head channels and feed-forward channels have random weights, and zero weights where they are read. The
  queries of a learned head that becomes wider are scaled by sqrt(new width / old width), since its softmax divides by
  the square root of the width.
- New layers add zero to the stream at first. They lie evenly between the old ones.

New inputs, the outdoor channels of a network of any kind (`added`), have weights of zero.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import cast

import torch
from torch import nn

from warpgarment.nn.architecture import GrowthError, build_network
from warpgarment.nn.attention import EncoderLayer
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.network import GarmentNetwork

from .network import ManifoldAwareTransformer

MAY_DIFFER = ("embedding", "layers", "feed_forward", "heads", "manifold_heads", "dropout")
UNEVEN = 0.5  # largest relative deviation of a share of a weight from equal shares, for two copies


def grow(small: GarmentNetwork, config: NetworkConfig, *, seed: int = 0) -> ManifoldAwareTransformer:
    """A larger network that predicts the same as a given one, on its device.

    Args:
        small: Network to start from, of faces (`architecture="faces"`); its statistics are kept.
        config: The shape wanted. Its embedding is a multiple of the network's. Its numbers of layers, feed-forward
            channels, learned heads, channels per learned head, and channels of all manifold heads together are at least
            the network's. `dropout` may differ; all other settings must be equal.
        seed: Seed for the weights that are initialised at random.

    Raises:
        GrowthError: The network is not one of faces, or cannot be grown to that shape.
    """
    if not isinstance(small, ManifoldAwareTransformer):
        raise GrowthError(
            f"only networks of faces can be grown; this one has architecture={small.config.architecture!r}, whose "
            "layers of faces have no rule for a larger shape. Leave out grow to train it further in its own shape, or "
            "grow a network of faces and start one of patches from that: init without grow, for a shape of patches "
            "with its widths"
        )
    _check(small.config, config)
    device, dtype = small.face_head.weight.device, small.face_head.weight.dtype
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        large = ManifoldAwareTransformer(config).to(dtype)
        _fill(large, copy.deepcopy(small).cpu())
    return large.to(device).train(small.training)


def added(network: GarmentNetwork, channels: Sequence[str]) -> GarmentNetwork:
    """A network that also reads some channels of `OUTDOOR`, with weights of zero, so that it predicts the same.

    Args:
        network: A network whose first layer of faces is `embed_faces`.
        channels: Names of channels of `OUTDOOR`, those that it reads already first and in their order.

    Returns:
        The network itself if it reads these channels already, or if none are named.

    Raises:
        ValueError: It reads other channels, or in another order.
    """
    before = network.config.outdoor
    if not channels or tuple(channels) == before:
        return network
    if tuple(channels[: len(before)]) != before:
        raise ValueError(
            f"the network reads the outdoor channels {','.join(before)}; more can only be added after these, as in "
            f"outdoor={','.join((*before, *(name for name in channels if name not in before)))}"
        )
    made = build_network(dataclasses.replace(network.config, outdoor=tuple(channels)))
    own = made.state_dict()
    for name, tensor in network.state_dict().items():
        if name == "embed_faces.weight":
            own[name].zero_()
            own[name][:, : tensor.shape[1]] = tensor.cpu()
        elif name.startswith("outdoor_"):
            own[name][: len(tensor)] = tensor.cpu()
        else:
            own[name].copy_(tensor.cpu())
    made.load_state_dict(own)
    weight = network.face_head.weight
    return made.to(weight.device, weight.dtype).train(network.training)


def untrained(network: GarmentNetwork) -> bool:
    """Whether a network has such channels but gives no weight to any, as the result of `added`."""
    width = network.outdoor.width
    return bool(width) and not bool(network.embed_faces.weight[:, -width:].any())


def _check(old: NetworkConfig, new: NetworkConfig) -> None:
    for field in dataclasses.fields(NetworkConfig):
        before, after = getattr(old, field.name), getattr(new, field.name)
        if field.name not in MAY_DIFFER and before != after:
            raise GrowthError(
                f"{field.name} is {before!r} and cannot become {after!r}: that would be another function; add "
                f"{field.name}={before} to the overrides"
            )
    if not old.norm_first:
        raise GrowthError("the network normalises after its layers (norm_first=false): a new layer would change it")
    if new.embedding % old.embedding:
        raise GrowthError(f"embedding {new.embedding} is not a multiple of {old.embedding}")
    widths = [(c.heads - c.manifold_heads, c.embedding // c.heads) for c in (old, new)]
    (heads, width), (more, wider) = widths
    manifold = [c.manifold_heads * c.embedding // c.heads for c in (old, new)]
    wanted = {
        "layers": (old.layers, new.layers),
        "feed_forward": (old.feed_forward, new.feed_forward),
        "learned heads": (heads, more),
        "channels of manifold heads": (manifold[0], manifold[1]),
    }
    if heads:
        wanted["channels of a head"] = (width, wider)
    for name, (before, after) in wanted.items():
        if after < before:
            raise GrowthError(f"{name}: {after}, fewer than the {before} there are")


def _fill(large: ManifoldAwareTransformer, small: ManifoldAwareTransformer) -> None:
    copies = large.config.embedding // small.config.embedding
    for name in small.statistics:
        getattr(large, name).copy_(getattr(small, name))
    for writes in ("embed_faces", "embed_velocity"):
        into, source = getattr(large, writes), getattr(small, writes)
        into.weight.copy_(source.weight.repeat(copies, 1))
        into.bias.copy_(source.bias.repeat(copies))
    _norm(large.final_norm, small.final_norm, copies)
    for reads in ("face_head", "velocity_head"):
        into, source = getattr(large, reads), getattr(small, reads)
        into.weight.copy_(_shared(source.weight, copies))
        into.bias.copy_(source.bias)
    before, after = small.config.layers, large.config.layers
    given, made = (cast(list[EncoderLayer], list(network.layers)) for network in (small, large))  # typed as modules
    places = {round(i * after / before): layer for i, layer in enumerate(given)}
    for place, layer in enumerate(made):
        if place in places:
            _layer(layer, places[place], small.config, large.config)
        else:
            for last in (layer.attention.out, layer.contract):
                nn.init.zeros_(last.weight)
                nn.init.zeros_(last.bias)


def _layer(into: EncoderLayer, source: EncoderLayer, old: NetworkConfig, new: NetworkConfig) -> None:
    copies = new.embedding // old.embedding
    _norm(into.attention_norm, source.attention_norm, copies)
    _norm(into.feed_forward_norm, source.feed_forward_norm, copies)

    hidden = old.feed_forward
    into.expand.weight[:hidden] = _shared(source.expand.weight, copies)
    into.expand.bias[:hidden] = source.expand.bias
    into.contract.weight.zero_()
    into.contract.weight[:, :hidden] = source.contract.weight.repeat(copies, 1)
    into.contract.bias.copy_(source.contract.bias.repeat(copies))

    # Rows of `qkv`: queries and keys of the manifold heads (unused), those of the learned heads, then all values.
    channels, parts = _head_channels(old, new)
    width = old.embedding // old.heads, new.embedding // new.heads
    scale = {"query": math.sqrt(width[1] / width[0])}
    into.attention.out.weight.zero_()
    into.attention.out.bias.copy_(source.attention.out.bias.repeat(copies))
    for name, rows_old, rows_new in parts:
        where = channels["value" if name == "value" else "learned"]
        weight, bias = source.attention.qkv.weight[rows_old], source.attention.qkv.bias[rows_old]
        into.attention.qkv.weight[rows_new][where] = scale.get(name, 1.0) * _shared(weight, copies)
        into.attention.qkv.bias[rows_new][where] = scale.get(name, 1.0) * bias
        if name == "query" and width[1] > width[0]:  # the scores of old heads come from their old channels alone
            fresh = torch.ones(rows_new.stop - rows_new.start, dtype=torch.bool)
            fresh[(old.heads - old.manifold_heads) * width[1] :] = False
            fresh[where] = False
            into.attention.qkv.weight[rows_new][fresh] = 0.0
    where = channels["value"]
    into.attention.out.weight[:, where] = source.attention.out.weight.repeat(copies, 1)


def _head_channels(
    old: NetworkConfig, new: NetworkConfig
) -> tuple[dict[str, torch.Tensor], list[tuple[str, slice, slice]]]:
    """Channels of the new heads that hold the old ones, and the rows of `qkv` of queries, keys and values."""
    width_old, width_new = old.embedding // old.heads, new.embedding // new.heads
    learned_old, learned_new = ((c.heads - c.manifold_heads) * c.embedding // c.heads for c in (old, new))
    number = torch.arange(learned_old)
    learned = number // width_old * width_new + number % width_old
    manifold = learned_new + torch.arange(old.embedding - learned_old)
    channels = {"learned": learned, "value": torch.cat([learned, manifold])}
    parts = []
    starts = [2 * (c.embedding - n) for c, n in ((old, learned_old), (new, learned_new))]
    lengths = [(learned_old, learned_new), (learned_old, learned_new), (old.embedding, new.embedding)]
    for name, (before, after) in zip(("query", "key", "value"), lengths, strict=True):
        parts.append((name, slice(starts[0], starts[0] + before), slice(starts[1], starts[1] + after)))
        starts = [starts[0] + before, starts[1] + after]
    return channels, parts


def _norm(into: nn.Module, source: nn.Module, copies: int) -> None:
    for name in ("weight", "bias"):
        getattr(into, name).copy_(getattr(source, name).repeat(copies))


def _shared(weight: torch.Tensor, copies: int) -> torch.Tensor:
    """Weights [O, copies * E] on a repeated stream with the result of [O,E] on one copy; shares sum to one."""
    share = torch.rand(copies, *weight.shape, dtype=weight.dtype) - 0.5
    share = 1.0 / copies + UNEVEN / copies * 2.0 * (share - share.mean(0))
    return (share * weight).transpose(0, 1).reshape(len(weight), -1)
