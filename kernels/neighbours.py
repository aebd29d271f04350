"""The nearest points of another cloud within a radius, each within its own group: edges between patches and bodies.

For every point p of group g, the nearest `count` of the targets y of its group with |p - y| <= radius, nearest first;
equally near ones in the order of their indices. Groups are the outfits of a batch, which may lie at the same
place. A hash grid with cells as wide as the radius finds the candidates, so a search costs what is near a point and not
what there is. Nothing waits for the device: results have a fixed width, and what is not there is -1.

    | symbol | code    | what                                                       |
    | ------ | ------- | ---------------------------------------------------------- |
    | p      | points  | points that search [m]                                     |
    | y      | targets | points that are found [m]                                  |
    | g      | group   | one search does not see the targets of other groups        |
    |        | skip    | targets that a point leaves out, such as its mesh edges    |
"""

from __future__ import annotations

import torch
import warp as wp

from . import compiling
from .launch import as_argument, as_warp, expect, torch_stream
from .operator import allocate

wp.set_module_options(compiling.options())

CELLS = 32  # along each axis; the grid repeats itself beyond, so this is a matter of speed alone
NOBODY = -1


@wp.kernel(enable_backward=False)
def nearest_points_kernel(
    # Model:
    grid: wp.uint64,
    radius: float,
    # In:
    points: wp.array[wp.vec3],
    group: wp.array[wp.int32],
    targets: wp.array[wp.vec3],
    skip: wp.array2d[wp.int32],
    # Out:
    found: wp.array2d[wp.int32],
    distance: wp.array2d[wp.float32],
):
    i = wp.tid()
    point = points[i]
    count = found.shape[1]
    for k in range(count):
        found[i, k] = -1
        distance[i, k] = wp.inf
    if not wp.isfinite(point):
        return
    query = wp.hash_grid_query(grid, point, radius, group[i])
    target = wp.int32(0)  # not a constant
    while wp.hash_grid_query_next(query, target):
        d = wp.length(targets[target] - point)
        if not d <= radius:
            continue
        for j in range(skip.shape[1]):
            if skip[i, j] == target:
                d = wp.inf
        last = count - 1
        if d > distance[i, last] or (d == distance[i, last] and (d == wp.inf or target > found[i, last])):
            continue
        k = last
        while k > 0 and (distance[i, k - 1] > d or (distance[i, k - 1] == d and found[i, k - 1] > target)):
            distance[i, k] = distance[i, k - 1]
            found[i, k] = found[i, k - 1]
            k -= 1
        distance[i, k] = d
        found[i, k] = target


class NearestPoints:
    """Searches with one hash grid, whose memory is kept from call to call.

    Args:
        device: Device of the points.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        with torch_stream(device) as warp_device:
            self._grid = wp.HashGrid(CELLS, CELLS, CELLS, device=warp_device)

    def __call__(
        self,
        points: torch.Tensor,
        group: torch.Tensor,
        targets: torch.Tensor,
        target_group: torch.Tensor,
        *,
        radius: float,
        count: int,
        skip: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Indices of the nearest targets of each point, without gradients.

        Args:
            points: Points that search [m], float32 [N,3]; one that is not finite finds nothing.
            group: Group of each point, int32 [N].
            targets: Points that are found [m], float32 [M,3].
            target_group: Group of each target, int32 [M].
            radius: Largest distance [m].
            count: Number of targets K that a point finds at most.
            skip: Targets that each point leaves out, int32 [N,S], padded with -1; None for none.

        Returns:
            Indices of targets, int32 [N,K], nearest first, padded with -1.

        Raises:
            TypeError, ValueError: Wrong dtypes, shapes or devices; a radius that is not positive; a count below 1.
        """
        expect("points", points, (None, 3), device=self.device)
        expect("group", group, (len(points),), torch.int32, self.device)
        expect("targets", targets, (None, 3), device=self.device)
        expect("target_group", target_group, (len(targets),), torch.int32, self.device)
        if not radius > 0.0 or count < 1:
            raise ValueError(f"radius must be positive and count at least 1, got {radius} and {count}")
        if skip is None:
            skip = torch.empty((len(points), 0), dtype=torch.int32, device=self.device)
        expect("skip", skip, (len(points), None), torch.int32, self.device)
        if not len(points) or not len(targets):
            return torch.full((len(points), count), NOBODY, dtype=torch.int32, device=self.device)
        found = allocate((len(points), count), torch.int32, self.device)
        distance = allocate((len(points), count), torch.float32, self.device)
        points, targets = points.detach().contiguous(), targets.detach().contiguous()
        with torch_stream(self.device) as warp_device:
            self._grid.build(as_warp(targets, wp.vec3), radius, groups=as_warp(target_group, wp.int32))
            inputs = [
                self._grid.id,
                radius,
                as_argument(points, wp.vec3),
                as_argument(group, wp.int32),
                as_argument(targets, wp.vec3),
                as_argument(skip, wp.int32),
            ]
            outputs = [as_argument(found, wp.int32), as_argument(distance, wp.float32)]
            wp.launch(nearest_points_kernel, dim=len(points), inputs=inputs, outputs=outputs, device=warp_device)
        return found
