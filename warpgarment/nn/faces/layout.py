"""Geodesic weights of the manifold heads: pooled, without a matrix of F x F for large garments, and for training.

    A v  ~  diag(1/s) P K P^T v        K = exp(-(D_c/r)^p) [C,C] between centres, s = P K P^T 1

P and D_c are defined in `geometry/pooled_geodesics.py`. A subset of faces takes its rows of P, and its own sums s. P
has a few entries in each row. Products with it use PyTorch's `embedding_bag`, which took a hundredth of the time of a
Warp kernel with a thread per entry, and a sixth of the time of torch.sparse, at 50,000 faces on one CPU core.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import csr_matrix

from warpgarment.geometry.pooled_geodesics import PooledGeodesics


class Bags(NamedTuple):
    """A sparse matrix [M,N] in CSR form: row i of A x sums weight[k] x[column[k]] over k in start[i]..start[i+1]-1."""

    start: torch.Tensor  # int64 [M+1]
    column: torch.Tensor  # int64 [nnz]
    weight: torch.Tensor  # [nnz]

    @classmethod
    def of(cls, matrix: csr_matrix, device: torch.device) -> Bags:
        """Copies a SciPy matrix to a device."""
        start, index = (torch.from_numpy(a.astype(np.int64)).to(device) for a in (matrix.indptr, matrix.indices))
        return cls(start, index, torch.from_numpy(np.ascontiguousarray(matrix.data)).to(device))


class _Product(torch.autograd.Function):
    """y = A x for a constant A. The gradient A^T dL/dy is also summed row by row, so that the result does not depend on
    the order of threads."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, *bags: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(*bags)
        start, index, weight = bags[:3]
        return F.embedding_bag(index, x, start, mode="sum", per_sample_weights=weight, include_last_offset=True)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        bags = ctx.saved_tensors
        return (_Product.apply(gradients[0].contiguous(), *bags[3:], *bags[:3]), *[None] * 6)


def bag_product(x: torch.Tensor, matrix: Bags, transposed: Bags) -> torch.Tensor:
    """The product A x, [N,K] -> [M,K], with x of the type of the weights; `transposed` is A^T, for the gradient."""
    return _Product.apply(x, *matrix, *transposed)


class PooledWeights(NamedTuple):
    """Weights of R rows of N faces over C centres, in place of a matrix [R,N,N] from `geodesic_weights`."""

    kernel: torch.Tensor  # [R,C,C], or [1,C,C] if all rows are of one garment
    interpolate: Bags  # P [R*N, R*C]
    collect: Bags  # its transpose
    scale: torch.Tensor  # [R,N], 1/s; 0 where padded

    @property
    def faces(self) -> int:
        """Number of faces N of a row."""
        return self.scale.shape[1]

    def to(self, dtype: torch.dtype) -> PooledWeights:
        """Returns itself: sums over thousands of centres need the precision in which the weights were made."""
        return self

    def spread(self, value: torch.Tensor) -> torch.Tensor:
        """Weights times values, [R,N,K] -> [R,N,K]; weights of one row apply to all rows of values."""
        rows, faces = self.scale.shape
        if rows == 1 and value.shape[0] > 1:
            batch, _, width = value.shape
            flat = value.transpose(0, 1).reshape(1, faces, batch * width)
            return self.spread(flat).reshape(faces, batch, width).transpose(0, 1)
        with torch.autocast(value.device.type, enabled=False):
            x = value.to(self.kernel.dtype).reshape(rows * faces, -1)
            pooled = bag_product(x, self.collect, self.interpolate)
            pooled = torch.matmul(self.kernel, pooled.reshape(rows, -1, x.shape[1])).flatten(0, 1)
            spread = bag_product(pooled, self.interpolate, self.collect).reshape(rows, faces, -1)
            return (spread * self.scale[..., None]).to(value.dtype)


def pooled_weights(
    rows: Sequence[tuple[PooledGeodesics, np.ndarray]],
    radius: float,
    power: float,
    device: torch.device,
    dtype: torch.dtype = torch.float32,
) -> PooledWeights:
    """Pooled weights of rows of faces.

    Args:
        rows: For each row, the pooled distances of its garment and the indices of its faces.
        radius: r [m].
        power: p, without unit.
        device: Device of the tensors.
        dtype: Type of the weights.
    """
    faces = max(len(subset) for _, subset in rows)
    centres = max(len(garment.distances) for garment, _ in rows)
    distinct = [rows[0][0]] if len({id(garment) for garment, _ in rows}) == 1 else [garment for garment, _ in rows]
    kernel = torch.zeros((len(distinct), centres, centres), dtype=dtype, device=device)
    for row, garment in zip(kernel, distinct, strict=True):
        count = len(garment.distances)
        row[:count, :count] = _kernel(garment, radius, power, device)
    start, index, weight = [np.zeros(1, np.int64)], [], []
    for number, (garment, subset) in enumerate(rows):
        chosen = garment.weight[subset]
        used = chosen != 0.0
        entries = np.zeros(faces, np.int64)
        entries[: len(subset)] = used.sum(axis=1)
        start.append(start[-1][-1] + np.cumsum(entries))
        index.append(garment.nearest[subset][used] + number * centres)
        weight.append(chosen[used])
    matrix = csr_matrix(
        (np.concatenate(weight), np.concatenate(index), np.concatenate(start)),
        shape=(len(rows) * faces, len(rows) * centres),
    ).astype(torch.empty(0, dtype=dtype).numpy().dtype)
    matrix.sort_indices()
    result = PooledWeights(
        kernel,
        Bags.of(matrix, device),
        Bags.of(matrix.T.tocsr(), device),
        torch.ones((len(rows), faces), dtype=dtype, device=device),
    )
    real = torch.zeros_like(result.scale)
    for mask, (_, subset) in zip(real, rows, strict=True):
        mask[: len(subset)] = 1.0
    return result._replace(scale=real / result.spread(real[..., None])[..., 0].where(real > 0, 1.0))


class Sampled(NamedTuple):
    """Geodesics of one garment on the device, from which training takes weights of many subsets of faces."""

    # exp(-(D/r)^p), float16 [F,F]: weights of a subset are its entries, divided by their row sums; or pooled distances
    geodesics: torch.Tensor | PooledGeodesics
    radius: float
    power: float
    device: torch.device

    @property
    def faces(self) -> int:
        """Number of faces F."""
        return len(self.geodesics) if isinstance(self.geodesics, torch.Tensor) else self.geodesics.faces

    def weights(self, faces: np.ndarray, scale: float = 1.0) -> torch.Tensor:
        """Weights of some faces [n], float32 [n,n], with all lengths of the garment multiplied by `scale`."""
        if not isinstance(self.geodesics, torch.Tensor):
            return dense_weights(self.geodesics, faces, self.radius / scale, self.power, self.device)
        chosen = torch.from_numpy(faces).to(self.device)
        kernel = self.geodesics[chosen[:, None], chosen[None, :]].float()
        if scale != 1.0:  # exp(-(s D/r)^p) = exp(-(D/r)^p)^(s^p)
            kernel = kernel ** float(scale**self.power)
        return kernel / kernel.sum(dim=1, keepdim=True)


def sampled(geometry: np.ndarray | PooledGeodesics, radius: float, power: float, device: torch.device) -> Sampled:
    """Makes a `Sampled` from geodesic distances between all faces [m], float32 [F,F], or from pooled ones."""
    if isinstance(geometry, PooledGeodesics):
        return Sampled(geometry, radius, power, device)
    kernel = torch.exp(-((torch.from_numpy(np.array(geometry)) / radius) ** power))
    return Sampled(kernel.to(device=device, dtype=torch.float16), radius, power, device)


def dense_weights(
    garment: PooledGeodesics, subset: np.ndarray, radius: float, power: float, device: torch.device
) -> torch.Tensor:
    """Pooled weights of one subset of n faces as a matrix, float32 [n,n], for n much smaller than F."""
    count, kernel = len(subset), _kernel(garment, radius, power, device)
    start = np.arange(count + 1) * garment.nearest.shape[1]
    shape = (count, len(kernel))
    matrix = csr_matrix((garment.weight[subset].ravel(), garment.nearest[subset].ravel(), start), shape=shape)
    bags, none = Bags.of(matrix, device), Bags(*torch.empty(3, 0, device=device))
    half = bag_product(kernel, bags, none)  # P K, and K is symmetric
    product = bag_product(half.T.contiguous(), bags, none)
    return product / product.sum(dim=1, keepdim=True)


def _kernel(garment: PooledGeodesics, radius: float, power: float, device: torch.device) -> torch.Tensor:
    distances = torch.from_numpy(garment.distances).to(device)
    return torch.exp(-((distances / radius) ** power)).where(torch.isfinite(distances), 0.0)
