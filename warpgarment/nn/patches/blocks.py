"""The network of patches on a CPU without gradients: faces by blocks, patches by garments, on the pool of threads.

A block of faces passes through a layer while its numbers are in the cache, and blocks and garments are shared among the
threads of `kernels/threads.py`. Where a block begins depends on the number of faces of its garment alone, so a garment
gets the same bits with any number of threads and in any batch. Operators are those of network.py, in another order:

    faces, by blocks      embedding; face layer
    garments              pooling, encoder layers, change of the patches
    faces, by blocks      the change spread to faces, norm; for each further face layer: the layer, the next norm; head

Where the widths are whole numbers of vectors, fused.py does the same by kernels; this is for all other networks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import torch
import torch.nn.functional as F

from warpgarment.kernels.threads import spread, torch_on_one
from warpgarment.nn.attention import one_by_one

from . import fused

if TYPE_CHECKING:
    from .layout import PatchLayout
    from .network import FaceLayer, PatchTransformer

BLOCK = 1024
"""Number of faces of a block, about: smaller ones cost more calls than they save in the cache of a core."""


def by_blocks(tensor: torch.Tensor) -> bool:
    """Whether the network runs as here on this input: on a CPU, in float32, without gradients."""
    kind = tensor.device.type
    plain = tensor.dtype == torch.float32 and not torch.is_grad_enabled() and not torch.is_autocast_enabled(kind)
    return kind == "cpu" and plain


def ranges(count: int) -> list[tuple[int, int]]:
    """First and last index of the blocks of a garment with that many faces."""
    parts = max(1, round(count / BLOCK))
    return [(count * part // parts, count * (part + 1) // parts) for part in range(parts)]


def _each_block(rows: int, count: int, do: Callable[[int, int, int], None]) -> None:
    """Calls `do(row, begin, end)` for all blocks of all rows, on several threads."""
    blocks = ranges(count)
    spread([lambda r=r, a=a, b=b: do(r, a, b) for r in range(rows) for a, b in blocks])  # type: ignore[misc]


def linear(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    """x Wᵀ + b by blocks: [R,N,I], weights [R,O,I] or [1,O,I] and [O] -> [R,N,O]."""
    result = x.new_empty((*x.shape[:2], weight.shape[1]))

    def block(r: int, a: int, b: int) -> None:
        torch.addmm(bias, x[r, a:b], weight[r % len(weight)].t(), out=result[r, a:b])

    with torch_on_one():
        _each_block(x.shape[0], x.shape[1], block)
    return result


@torch_on_one()
def forward(
    network: PatchTransformer,
    faces: torch.Tensor,
    tokens: torch.Tensor,
    layout: PatchLayout,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The network from embedded faces to the outputs of its heads.

    Args:
        network: The network.
        faces: Embedded faces, shape [R,N,F]; overwritten.
        tokens: Embedded velocities, shape [R,C,E].
        layout: Patches of R rows, or of one row that serves all.
        mask: True where a token is real, shape [R,1,1,P+C]; None where all are.

    Returns:
        Normalised Psi and singular values, shape [R,N,12]; normalised velocities [R,C,3].
    """
    rows, count, width = faces.shape
    patches = layout.start.shape[1]
    if fused.fits(network, patches + tokens.shape[1]):
        return fused.forward(fused.packed(network), faces, tokens, layout, mask)
    own = list(torch.empty((2, *faces.shape)))
    heard = faces.new_empty((rows, patches, width))
    answer = faces.new_empty((rows, count, network.face_head.out_features))
    velocities: list[torch.Tensor] = [tokens] * rows
    layers = [cast("FaceLayer", layer) for layer in network.after]

    def of(values: torch.Tensor, row: int) -> torch.Tensor:
        return values[row % len(values)]

    def before(r: int, a: int, b: int) -> None:
        x = faces[r, a:b]
        _perceptron(network.before, x, network.before.norm(x), None)

    def patch(r: int) -> None:
        members, shares = of(layout.member, r), of(layout.member_weight, r)
        pooled = F.embedding_bag(members, faces[r], of(layout.start, r), mode="sum", per_sample_weights=shares)[None]
        mean = of(layout.pieces, r) @ pooled
        x = torch.cat([network.to_patches(pooled), tokens[r : r + 1] + one_by_one(network.to_velocity, mean)], dim=1)
        start, geodesic, real = x, of(layout.weights, r)[None], None if mask is None else of(mask, r)[None]
        for layer in network.layers:
            x = layer(x, geodesic, real)
        heard[r] = network.from_patches((x - start)[0, :patches])
        velocities[r] = one_by_one(network.velocity_head, network.final_norm(x)[:, patches:])

    def spread_out(r: int, a: int, b: int) -> None:
        x = faces[r, a:b]
        share = of(layout.share, r)[a:b]
        x += F.embedding_bag(of(layout.patch, r)[a:b], heard[r], mode="sum", per_sample_weights=share)
        finish(0, r, a, b)

    def finish(done: int, r: int, a: int, b: int) -> None:
        x = faces[r, a:b]
        if done < len(layers):
            own[done % 2][r, a:b] = layers[done].norm(x)
        else:
            answer[r, a:b] = network.face_head(network.face_norm(x))

    def after(number: int, r: int, a: int, b: int) -> None:
        mine, around = own[number % 2][r], None
        if layout.neighbours is not None:
            around = F.embedding_bag(of(layout.neighbours, r)[a:b], mine, mode="sum")
        _perceptron(layers[number], faces[r, a:b], mine[a:b], around)
        finish(number + 1, r, a, b)

    _each_block(rows, count, before)
    spread([lambda r=r: patch(r) for r in range(rows)])  # type: ignore[misc]
    _each_block(rows, count, spread_out)
    for number in range(len(layers)):
        _each_block(rows, count, lambda r, a, b, number=number: after(number, r, a, b))  # type: ignore[misc]
    return answer, torch.cat(velocities)


def _perceptron(layer: FaceLayer, x: torch.Tensor, own: torch.Tensor, around: torch.Tensor | None) -> None:
    """Adds to faces [B,F] what a face layer makes of their norms, and of the sums over three neighbours."""
    hidden = layer.expand(own)
    if around is not None:
        hidden = torch.addmm(hidden, around, layer.hear.weight.t(), alpha=1.0 / 3.0)
    x += layer.contract(layer.activation(hidden))
