"""The shape of the trees of tree.py: which faces are in which leaf, and which leaves and nodes in which node.

It is found once, from one pose: the faces of a node are halved three times, at the median along the longest side of the
box around their centres, into as many children as are needed at the depth of a full tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LANES = 8
"""Children of a node, and triangles of a leaf."""


class Shape(NamedTuple):
    """Trees without positions, made by `shape_of`."""

    nodes: np.ndarray
    """Node at which each body begins, and their number N, int32 [B + 1]."""
    children: np.ndarray
    """As in `Tree`, int32 [N]."""
    node_places: np.ndarray
    """Eight times the parent of each node, plus its lane there; -1 for roots; int32 [N]."""
    leaf_places: np.ndarray
    """The same of each leaf, int32 [L]."""
    faces: np.ndarray
    """Packed faces of each leaf, -1 in lanes that are not used, int32 [L, 8]."""
    first_face: np.ndarray
    """First face of the body of each leaf, int32 [L]."""


def shape_of(centres: np.ndarray, face_starts: list[int]) -> Shape:
    """The trees of a batch of bodies.

    Args:
        centres: Centres of the faces in some pose [m], packed, [G, 3], finite.
        face_starts: Index at which the faces of each body begin, and G, [B + 1]; every body has faces.
    """
    starts, sizes = np.asarray(face_starts[:-1]), np.diff(face_starts)
    leaves = -(-sizes // LANES)
    depth = np.ones(len(sizes), int)
    while (short := LANES**depth < leaves).any():
        depth[short] += 1
    order = np.arange(len(centres))
    body, parent, begin, count, held = (np.zeros(0, int) for _ in range(5))  # of a level; `held` is in leaves
    bodies, parents, total = list[np.ndarray](), list[np.ndarray](), 0
    for height in range(int(depth.max()), -1, -1):
        new = np.nonzero(depth == height)[0]
        body, parent = np.append(body, new), np.append(parent, np.full(len(new), -1))
        begin, count, held = (
            np.append(old, more[new]) for old, more in ((begin, starts), (count, sizes), (held, leaves))
        )
        if height:
            bodies.append(body)
            parents.append(parent)
            number, total = total + np.arange(len(body)), total + len(body)
            parts = -(-held // LANES ** (height - 1))
            body, parent = np.repeat(body, parts), np.repeat(number, parts)
            begin, count, held = _cut(centres, order, begin, count, held, parts)
    body_of_node, parent_of_node = np.concatenate(bodies), np.concatenate(parents)
    by_body, leaf_by_body = np.argsort(body_of_node, kind="stable"), np.argsort(body, kind="stable")
    renamed = np.empty(total + 1, int)
    renamed[by_body], renamed[-1] = np.arange(total), -1
    node_parent, leaf_parent = renamed[parent_of_node[by_body]], renamed[parent[leaf_by_body]]
    children = np.empty(total, int)
    # Backwards, so that the first child is what stays.
    below = np.nonzero(node_parent >= 0)[0][::-1]
    children[node_parent[below]] = below
    children[leaf_parent[::-1]] = ~np.arange(len(leaf_parent))[::-1]
    begin, count = begin[leaf_by_body], count[leaf_by_body]
    lanes = np.arange(LANES)
    faces = np.where(lanes < count[:, None], order[np.minimum(begin[:, None] + lanes, len(order) - 1)], -1)
    node_places = LANES * node_parent + np.arange(total) - children[node_parent]
    found = (
        np.searchsorted(body_of_node[by_body], np.arange(len(sizes) + 1)),
        children,
        np.where(node_parent < 0, -1, node_places),
        LANES * leaf_parent + np.arange(len(leaf_parent)) - ~children[leaf_parent],
        faces,
        starts[body[leaf_by_body]],
    )
    return Shape(*(values.astype(np.int32) for values in found))


def _cut(
    centres: np.ndarray, order: np.ndarray, begin: np.ndarray, count: np.ndarray, held: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts runs of `order` by halves into `parts` runs each, and sorts it so that each of them is compact."""
    while (cut := np.nonzero(parts > 1)[0]).size:
        lengths = count[cut]
        first = np.cumsum(lengths) - lengths
        places = np.repeat(begin[cut] - first, lengths) + np.arange(lengths.sum())
        here = centres[order[places]]
        axis = np.argmax(np.maximum.reduceat(here, first) - np.minimum.reduceat(here, first), axis=1)
        along = here[np.arange(len(here)), np.repeat(axis, lengths)]
        order[places] = order[places][np.argsort(_key(np.repeat(np.arange(len(cut)), lengths), along))]
        left = parts[cut] // 2
        left_held = held[cut] * left // parts[cut]
        left_count = lengths * left_held // held[cut]
        repeats = 1 + (parts > 1)
        second = np.cumsum(repeats)[cut] - 1
        begin, count, held, parts = (np.repeat(values, repeats) for values in (begin, count, held, parts))
        for values, share in ((count, left_count), (held, left_held), (parts, left)):
            values[second - 1] = share
            values[second] -= share
        begin[second] += left_count
    return begin, count, held


def _key(run: np.ndarray, along: np.ndarray) -> np.ndarray:
    """One integer that sorts by run and then by a float32 number: a third of the time of a sort by two keys."""
    bits = np.ascontiguousarray(along, np.float32).view(np.uint32)
    rising = np.where(bits >> 31, ~bits, bits | np.uint32(2**31))  # integers in the order of the numbers
    return (run.astype(np.uint64) << np.uint64(32)) | rising
