"""The network of patches on a CPU as kernels of `kernels/dense`, which have all between two products in them.

Weights are packed once per network. The scale and shift of a layer norm are part of the layer after it:

    W (g n(x) + s) + b = (W g) n(x) + (b + W s)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import nn

from warpgarment.kernels.deformation.steps import steps
from warpgarment.kernels.dense import faces as dense
from warpgarment.kernels.dense import heading as heads
from warpgarment.kernels.dense import products, tokens
from warpgarment.kernels.dense.turned import MOST_INPUTS, VECTOR, turned
from warpgarment.kernels.features.channels import FEATURES, LAYOUT, Kind, Layout
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.replay.recording import passing, recording
from warpgarment.nn.inputs import Frames
from warpgarment.nn.parametrisation import Step

from . import changes

if TYPE_CHECKING:
    from warpgarment.nn.attention import EncoderLayer
    from warpgarment.nn.config import NetworkConfig
    from warpgarment.nn.inputs import FrameInputs
    from warpgarment.nn.rows import RowLayout

    from .layout import PatchLayout
    from .network import FaceLayer, PatchTransformer


class Packed(NamedTuple):
    """The weights of the layers of faces as the kernels read them."""

    sources: changes.Sources  # the parameters and statistics they were made from
    embed: torch.Tensor  # [F,H,K], over the deviations of the features
    bias: torch.Tensor  # [F]
    heading: heads.Model
    step_scale: torch.Tensor  # [24], deviations of psi and sigma, then their means
    velocity_scale: torch.Tensor  # [6], deviations of the velocities of pieces, then their means
    first: dense.Perceptron
    after: list[dense.Perceptron]  # for faces that hear their neighbours
    alone: list[dense.Perceptron]  # for subsets of faces
    head: dense.Head
    encoder: tokens.Encoder


STATISTICS = (
    "feature_std",
    *(f"{name}_{kind}" for name in ("velocity", "psi", "singular_value", "q") for kind in ("std", "mean")),
)
_known: WeakKeyDictionary[nn.Module, Packed] = WeakKeyDictionary()
_fitting: WeakKeyDictionary[nn.Module, tuple[NetworkConfig, bool]] = WeakKeyDictionary()


LAUNCHED = "dense.tokens", "dense.faces", "dense.turned", "dense.heading", "dense.products"
"""Modules of `warpgarment.kernels` with the kernels of the layers, slow ones first."""


def fits(network: PatchTransformer, count: int = 0) -> bool:
    """Whether the kernels can do this network's layers, on rows of that many tokens and on this processor."""
    return suits(network, count) and products.available()


def suits(network: PatchTransformer, count: int = 0) -> bool:
    """Whether this processor has vectors, and the widths are whole numbers of tiles; nothing is compiled."""
    config, fit = _fitting.get(network, (None, False))
    if config is not network.config:
        config, fit = network.config, planned(network.config)
        _fitting[network] = config, fit
    return fit and count <= tokens.MOST_TOKENS


def planned(config: NetworkConfig) -> bool:
    """The same of a network that is not made yet."""
    return products.present() and _widths_fit(config)


def packed_bytes(config: NetworkConfig) -> int:
    """Memory of the packed weights of a network."""
    width, hidden, e, wide = config.face_embedding, config.face_feed_forward, config.embedding, config.feed_forward
    columns = 3 * e - 2 * config.manifold_heads * (e // config.heads)
    inner = width * hidden * (2 + 3 * config.face_layers) + config.layers * e * (columns + e + 2 * wide)
    outer = width * (config.inputs + 3 * e + products.STEP)
    return outer * 4 + inner * (2 if products.INTEGERS else 4)


def _widths_fit(config: NetworkConfig) -> bool:
    """Whether the kernels have room for the layers of such a network."""
    widths = (config.face_embedding, config.face_feed_forward, config.embedding, config.feed_forward)
    head = config.embedding // config.heads
    columns = 3 * config.embedding - 2 * config.manifold_heads * head
    fit = all(width % products.STEP == 0 and width <= products.WIDEST for width in widths)
    fit = fit and head % products.STEP == 0 and columns <= tokens.MOST_COLUMNS and config.inputs <= MOST_INPUTS
    return fit and config.norm_first and config.activation == "gelu"


def packed(network: PatchTransformer) -> Packed:
    """The packed weights of a network, made anew when a weight has changed."""
    known = _known.get(network)
    if known is None or not known.sources.unchanged():
        known = _pack(network)
        if known.sources.counted:
            _known[network] = known
    return known


def look(network: PatchTransformer) -> None:
    """Forgets packed weights if the network's are other ones, also where torch has not counted a change."""
    known = _known.get(network)
    if known is not None and known.sources.written():
        del _known[network]


def _sources(network: PatchTransformer) -> changes.Sources:
    """All parameters of a network and the statistics that are part of its weights."""
    parameters = [(module._parameters, name) for module in network.modules() for name in module._parameters]
    return changes.Sources([*parameters, *((network._buffers, name) for name in STATISTICS)])


def _pack(network: PatchTransformer) -> Packed:
    weight = network.embed_faces.weight
    weight = weight[:, : weight.shape[1] - network.outdoor.width].unflatten(1, (-1, network.channels.width))
    layers = [cast("FaceLayer", layer) for layer in network.after]
    head, head_bias = folded(network.face_norm, network.face_head.weight, network.face_head.bias)
    return Packed(
        _sources(network),
        (weight / network.feature_std).contiguous(),
        network.embed_faces.bias.detach(),
        heads.Model(
            *factors(network.channels),
            torch.cat([network.velocity_std, network.velocity_mean]),
            network.embed_velocity.weight.detach(),
            network.embed_velocity.bias.detach(),
            network.config.heading == "canonical",
        ),
        torch.cat([network.psi_std, network.singular_value_std, network.psi_mean, network.singular_value_mean]),
        torch.cat([network.q_std, network.q_mean]),
        _perceptron(network.before, hears=False),
        [_perceptron(layer, hears=True) for layer in layers],
        [_perceptron(layer, hears=False) for layer in layers],
        dense.Head(packed_weights(head), head_bias),
        _encoder(network),
    )


def factors(layout: Layout) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the two factors of each entry of `layout.turn(G)` are, which is padded to columns of sixteen.

    Returns:
        Indices into the nine entries of G, one and zero: two arrays of int64 [K * K'].
    """
    one, zero = 9, 10
    place = np.full((2, layout.width, -(-layout.width // VECTOR) * VECTOR), zero)
    for channel in layout.channels:
        begin = layout.slices[channel.name].start
        if channel.kind is Kind.SCALAR:
            for i in range(channel.width):
                place[:, begin + i, begin + i] = one
        for i, j, k, n in np.ndindex(3, 3, 3, 3):
            row, column = begin + 3 * i + k, begin + 3 * j + n
            if channel.kind is Kind.MAP:
                place[:, row, column] = 3 * i + j, 3 * k + n
            elif channel.kind is Kind.FROM_REST and k == n:
                place[:, row, column] = 3 * i + j, one
            elif channel.kind in (Kind.VECTOR, Kind.POINT):
                place[:, begin + i, begin + j] = 3 * i + j, one
    first, second = torch.from_numpy(place).flatten(1)
    return first, second


def _encoder(network: PatchTransformer) -> tokens.Encoder:
    config = network.config
    head = config.embedding // config.heads
    unused = 2 * config.manifold_heads * head
    learned = config.embedding - config.manifold_heads * head
    root = torch.ones(2 * learned + config.embedding)
    root[:learned] = head**-0.5
    weights, biases = [], []
    for layer in cast("list[EncoderLayer]", network.layers):
        qkv, out = layer.attention.qkv, layer.attention.out
        weight, bias = folded(layer.attention_norm, qkv.weight[unused:], qkv.bias[unused:])
        expand, expand_bias = folded(layer.feed_forward_norm, layer.expand.weight, layer.expand.bias)
        weights += [weight * root[:, None], out.weight, expand, layer.contract.weight]
        biases += [bias * root, out.bias, expand_bias, layer.contract.bias]
    velocity, velocity_bias = folded(network.final_norm, network.velocity_head.weight, network.velocity_head.bias)
    biases += [network.from_patches.bias, velocity_bias, velocity, network.to_velocity.weight]
    return tokens.Encoder(
        config.embedding,
        learned,
        head,
        config.feed_forward,
        config.layers,
        packed_weights(network.to_patches.weight),
        network.to_patches.bias.detach(),
        torch.cat([*map(products.pack_inner, weights), packed_weights(network.from_patches.weight)]),
        torch.cat([values.flatten() for values in biases]),
    )


def packed_weights(weight: torch.Tensor) -> torch.Tensor:
    """Packed weights in one dimension."""
    return products.pack(weight).flatten()


def folded(norm: nn.Module, weight: torch.Tensor, bias: torch.Tensor | Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights and biases of a layer with the scale and shift of the norm before it."""
    norm = cast("nn.LayerNorm", norm)
    return weight * norm.weight, bias + weight @ norm.bias


def _perceptron(layer: FaceLayer, *, hears: bool) -> dense.Perceptron:
    weight, bias = folded(layer.norm, layer.expand.weight, layer.expand.bias)
    if hears:
        around, bias = folded(layer.norm, layer.hear.weight, bias)
        weight = torch.cat([weight, around], dim=1)
    expand, contract = products.pack_inner(weight), products.pack_inner(layer.contract.weight)
    return dense.Perceptron(expand, bias, contract, layer.contract.bias.detach())


def predicts(network: PatchTransformer, layout: RowLayout) -> bool:
    """Whether `predict` can do this batch."""
    views = layout.views
    return all(fits(network, view.weights.start.shape[1] + view.piece.shape[1]) for view in views)


def predict(network: PatchTransformer, inputs: FrameInputs, layout: RowLayout) -> Step:
    """`GarmentNetwork.predict` on a CPU without gradients, by launches that have all operators in them."""
    features, newest, velocities, outside = network.packed_inputs(inputs, layout)
    frames = features.frames if isinstance(features, Frames) else features.unflatten(1, (-1, FEATURES)).unbind(1)
    read = [network.read(frame) for frame in frames]
    weights, residual = packed(network), network.config.residual
    columns = (LAYOUT[name].start for name in ("deformation_gradient", "body_velocity", "body_deformation"))
    gradient, body_velocity, body = columns
    shapes = (len(newest), 3, 3), (len(newest), 3), (len(velocities), 3)
    step = Step(*(allocate(shape, newest.dtype, newest.device) for shape in shapes))
    views = layout.views
    if recording():  # launches of a replay cost little, so each garment goes through all layers while caches hold it
        views = [one for view in views for one in view.one_by_one]
    for view in views:
        with passing():
            rows = heads.Rows(view.index, view.piece, layout.face_component)
            found = heads.heading(newest, velocities, rows, weights.heading, gradient, body_velocity)
            faces = dense.embed(
                read, rows.face, *turned(weights.embed, network.feature_mean, found.turns), weights.bias
            )
            if network.outdoor.width:
                outdoor = None if outside is None else network.known(view.faces(outside))
                if outdoor is not None:
                    outdoor = outdoor @ network.outdoor.turn(found.turn).mT
                faces = network.with_outdoor(faces, outdoor, None, embedded=True)
            mask = network.key_mask(view.weights, view.component_mask, found.tokens)
            answer, velocity = forward(weights, faces, found.tokens, view.weights, mask)
            written = step.psi, step.singular_values
            steps(answer, weights.step_scale, found.turn, rows.face, newest, body, written, residual=residual)
            heads.velocities(velocity, found, rows, weights.velocity_scale, step.velocity, residual=residual)
    return step


def embedded(network: PatchTransformer, features: torch.Tensor, turn: torch.Tensor | None) -> torch.Tensor:
    """`PatchTransformer.embedded` of features [R,N,H*K] that hold the channels the network reads."""
    weights = packed(network)
    turn = torch.eye(3)[None] if turn is None else turn
    entries = torch.cat([turn.flatten(1), torch.tensor([1.0, 0.0]).expand(len(turn), -1)], dim=1)
    turns = entries[:, weights.heading.first] * entries[:, weights.heading.second]
    index = torch.arange(features.shape[0] * features.shape[1]).reshape(features.shape[:2])
    centre_and_weight = turned(weights.embed, network.feature_mean, turns)
    frames = features.flatten(0, 1).unflatten(1, (-1, network.channels.width)).unbind(1)
    return dense.embed(frames, index, *centre_and_weight, weights.bias)


def forward(
    weights: Packed,
    faces: torch.Tensor,
    given: torch.Tensor,
    layout: PatchLayout,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The network from embedded faces to the outputs of its heads; arguments and result as of `blocks.forward`."""
    dense.first(faces, weights.first)
    pools = tokens.Pools(layout.start, layout.member, layout.member_weight, layout.pieces, layout.weights)
    real = None if mask is None else mask.flatten(1)
    heard, velocity = tokens.encode(weights.encoder, faces, given, pools, real)
    own = dense.spread(faces, layout.patch, layout.share, heard)
    layers = weights.alone if layout.neighbours is None else weights.after
    if not layers:
        return dense.head(own, weights.head), velocity
    room = allocate(own.shape, own.dtype, own.device)
    for layer in layers[:-1]:
        dense.hear(faces, own, layout.neighbours, layer, room)
        own, room = room, own
    answer = allocate((*own.shape[:2], len(weights.head.bias)), own.dtype, own.device)
    dense.hear(faces, own, layout.neighbours, layers[-1], answer, weights.head)
    return answer, velocity
