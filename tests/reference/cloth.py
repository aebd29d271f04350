"""Float64 twins of kernels/cloth and features/carry_together.py: every pair of faces one by one, without trees."""

from __future__ import annotations

import itertools

import numpy as np
from trimesh.triangles import closest_point

TOUCHING, SAFE, SLOPE, INNER, INSIDE = 2e-6, 5e-4, 0.34, 0.3, 0.9
ONE_MOVE, MOST = 0.004, 4.0


def on_segment(p, a, b):
    """The point of each segment a b that is nearest to each point p, [N,3]."""
    u = b - a
    return a + np.clip(((p - a) * u).sum(1) / (u * u).sum(1), 0, 1)[:, None] * u


def nearest(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of triangles p and q [N,3,3] among the 6 pairs of corner and face and the 9 pairs of edges.

    Two segments are nearest at the ends of one of them, or where the line between them is perpendicular to both.
    """
    on_p, on_q = [], []
    for i in range(3):
        on_p += [p[:, i], closest_point(p, q[:, i])]
        on_q += [closest_point(q, p[:, i]), q[:, i]]
    for i, j in itertools.product(range(3), range(3)):
        a, b, c, d = p[:, i], p[:, (i + 1) % 3], q[:, j], q[:, (j + 1) % 3]
        on_p += [a, b, on_segment(c, a, b), on_segment(d, a, b)]
        on_q += [on_segment(a, c, d), on_segment(b, c, d), c, d]
        u, v, w = b - a, d - c, c - a
        across = np.cross(u, v)
        square = np.maximum((across * across).sum(1), 1e-300)
        s, t = (np.cross(w, v) * across).sum(1) / square, (np.cross(w, u) * across).sum(1) / square
        inside = ((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1))[:, None]
        on_p.append(np.where(inside, a + s[:, None] * u, 1e6))
        on_q.append(np.where(inside, c + t[:, None] * v, -1e6))
    x, y = np.stack(on_p), np.stack(on_q)
    best = ((x - y) ** 2).sum(2).argmin(0)
    row = np.arange(len(p))
    return x[best, row], y[best, row]


def gap(p, q, n):
    """Gap of triangles [N,3,3] along directions [N,3]."""
    return (p * n[:, None]).sum(2).min(1) - (q * n[:, None]).sum(2).max(1)


def separating(p, q):
    """Unit vectors from q to p, [N,3]; zero for triangles that cross."""
    x, y = nearest(p, q)
    length = np.linalg.norm(x - y, axis=1)
    n = (x - y) / np.maximum(length, 1e-300)[:, None]
    return np.where(((length > TOUCHING) & (gap(p, q, n) > TOUCHING))[:, None], n, 0.0)


def pairs(start, end, faces, garment, outfit, itself, moving, margin) -> set[tuple[int, int]]:
    """Pairs (m, o), m keeping the pair, whose boxes overlap."""
    both = np.concatenate([start[faces], end[faces]], axis=1).astype(np.float64)
    low, high = both.min(1) - margin, both.max(1) + margin
    found = set()
    for m, o in itertools.combinations(range(len(faces)), 2):
        if outfit[m] != outfit[o] or not (moving[garment[m]] and moving[garment[o]]):
            continue
        if garment[m] == garment[o] and (not itself or set(faces[m]) & set(faces[o])):
            continue
        if (low[m] <= high[o]).all() and (low[o] <= high[m]).all():
            found.add((m, o) if keeper(m, o) == m else (o, m))
    return found


def directions(start, end, faces, m, o, thickness):
    """Normals of pairs, whether each may have to be pushed, and its nearest points at the start as weights [N,6]."""
    p, q, p1, q1 = start[faces[m]], start[faces[o]], end[faces[m]], end[faces[o]]
    normal, settled = np.zeros((len(m), 3)), np.zeros(len(m), bool)
    for axis in (
        np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]),
        np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]),
        p.sum(1) - q.sum(1),
    ):
        for sign in (1.0, -1.0):
            n = sign * axis / np.linalg.norm(axis, axis=1)[:, None]
            clear = ~settled & (gap(p, q, n) > TOUCHING) & (gap(p1, q1, n) > thickness)
            normal[clear], settled = n[clear], settled | clear
    normal[~settled] = separating(p, q)[~settled]
    x, y = nearest(p, q)
    u, v = (np.linalg.solve(t.transpose(0, 2, 1), z[:, :, None])[:, :, 0] for t, z in ((p, x), (q, y)))
    return normal, ~settled & normal.any(1), np.concatenate([u, v], axis=1)


def pushed(start, end, faces, garment, rank, found, thickness, rounds, margin):
    """The end with pushes, [V,3]."""
    m, o = np.array(sorted(found)).T
    normal, pushes, weights = directions(start, end, faces, m, o, thickness)
    points = end.copy()
    for _ in range(rounds):
        sums, total = np.zeros_like(points), np.zeros(len(points))
        for k in np.flatnonzero(pushes):
            corner = np.concatenate([faces[m[k]], faces[o[k]]])
            first, second = rank[garment[m[k]]], rank[garment[o[k]]]
            share = np.repeat([INNER if first < second else 1.0, INNER if second < first else 1.0], 3)
            signed = weights[k] * np.repeat([1.0, -1.0], 3)
            missing = thickness - normal[k] @ (signed @ points[corner])
            if missing > 0:
                amount = missing / (share * weights[k] ** 2).sum()
                np.add.at(sums, corner, (weights[k] * share * signed * amount)[:, None] * normal[k])
                np.add.at(total, corner, weights[k])
        points = limited(points, sums, total, start, end, margin)
    return points


def one_axis(p0, q0, p, q, axis):
    """Whether a direction separates pairs before and after, [N]."""
    length = np.linalg.norm(axis, axis=1)
    n = axis / np.maximum(length, 1e-300)[:, None]
    before = gap(p0, q0, n)
    return (length > 0) & (before > TOUCHING) & (gap(p, q, n) > np.minimum(SAFE, TOUCHING + 0.9 * (before - TOUCHING)))


def safe(start, points, faces, m, o, normal):
    """Whether pairs are safe, [N]."""
    p0, q0, p, q = start[faces[m]], start[faces[o]], points[faces[m]], points[faces[o]]
    now = separating(p, q)
    found = one_axis(p0, q0, p, q, normal) | (gap(p, q, normal) > SAFE)
    return found | (now.any(1) & (one_axis(p0, q0, p, q, now) | one_axis(p0, q0, p, q, now + normal)))


def freed(start, faces, garment, rank, found, normal, rounds, least):
    """Normals of the pairs, zero for those that are set free around crossings of layers."""
    order, normal = sorted(found), normal.copy()
    area = np.cross(start[faces[:, 1]] - start[faces[:, 0]], start[faces[:, 2]] - start[faces[:, 0]])
    area /= np.linalg.norm(area, axis=1)[:, None]
    layers = [k for k, (m, o) in enumerate(order) if garment[m] != garment[o]]
    marked = {int(i) for k in layers if not normal[k].any() for i in faces[list(order[k])].ravel()}
    for _ in range(rounds):
        near = set(marked)
        for k in layers:
            m, o = order[k]
            if normal[k].any() and near & set(faces[[m, o]].ravel().tolist()) and area[m] @ area[o] > 0:
                way = normal[k] if rank[garment[m]] > rank[garment[o]] else -normal[k]
                if way @ (area[m] + area[o]) < least * np.linalg.norm(area[m] + area[o]):
                    normal[k] = 0.0
                    marked |= set(faces[[m, o]].ravel().tolist())
    return normal


def keeper(m, o):
    """Which of two faces keeps their pair."""
    return min(m, o) if (m + o) % 2 == 0 else max(m, o)


def parted(start, end, points, faces, garment, rank, found, normal, rounds, margin):
    """Positions after pairs that are not safe were parted, [V,3]."""
    m, o = np.array(sorted(found)).T
    apart, points = normal.any(1), points.copy()
    kept = np.minimum(2 * SAFE, gap(start[faces[m]], start[faces[o]], normal))
    for _ in range(rounds):
        sums, total = np.zeros_like(points), np.zeros(len(points))
        for k in np.flatnonzero(apart & ~safe(start, points, faces, m, o, normal)):
            p, q, n = points[faces[m[k]]] @ normal[k], points[faces[o[k]]] @ normal[k], normal[k]
            first, second = rank[garment[m[k]]], rank[garment[o[k]]]
            s, t = INNER if first < second else 1.0, INNER if second < first else 1.0
            missing = kept[k] - (p.min() - q.max())
            moves = (
                np.maximum(p.min() + missing * s / (s + t) - p, 0),
                np.maximum(q - (q.max() - missing * t / (s + t)), 0),
            )
            for face, move, sign in ((faces[m[k]], moves[0], 1), (faces[o[k]], moves[1], -1)):
                weight = np.minimum(move / ONE_MOVE, MOST)
                np.add.at(sums, face, (sign * weight * move)[:, None] * n)
                np.add.at(total, face, weight)
        points = limited(points, sums, total, start, end, margin)
    return points


def limited(points, sums, total, start, end, margin):
    """Points moved by the means of pushes, inside the boxes of their motion."""
    moved = points + sums / np.maximum(total, 1e-300)[:, None]
    room = INSIDE * margin
    moved = np.clip(moved, np.minimum(start, end) - room, np.maximum(start, end) + room)
    return np.where(total[:, None] > 0, moved, points)


def safe_steps(start, end, faces, outfit, found, normal, shrinks):
    """Positions, and which outfits stay."""
    m, o = np.array(sorted(found)).T
    apart = normal.any(1)
    share, points = np.ones(len(start)), end.copy()
    for shrink in shrinks:
        smaller = share.copy()
        wrong = np.flatnonzero(apart & ~safe(start, points, faces, m, o, normal))
        for k in wrong:
            corner = np.concatenate([faces[m[k]], faces[o[k]]])
            smaller[corner] = np.minimum(smaller[corner], shrink * share[corner])
        share = smaller.copy()
        for face in faces[np.isin(outfit, outfit[m[wrong]])]:
            share[face] = np.minimum(share[face], smaller[face].min() + SLOPE)
        points = np.where(share[:, None] < 1, start + share[:, None] * (end - start), points)
    wrong = apart & ~safe(start, points, faces, m, o, normal)
    held = set(outfit[m[wrong]].tolist())
    for number in held:
        corner = np.unique(faces[outfit == number])
        points[corner] = start[corner]
    return points, held


def crosses(p: np.ndarray, q: np.ndarray) -> bool:
    """Whether an edge of one triangle passes through the other; [3,3] each."""
    for one, other in ((p, q), (q, p)):
        n = np.cross(other[1] - other[0], other[2] - other[0])
        for i in range(3):
            a, b = one[i], one[(i + 1) % 3]
            ha, hb = n @ (a - other[0]), n @ (b - other[0])
            if ha * hb < 0:
                x = a + ha / (ha - hb) * (b - a)
                sides = [n @ np.cross(other[(k + 1) % 3] - other[k], x - other[k]) for k in range(3)]
                if min(sides) > 0:
                    return True
    return False


def crossings(points, faces, garment, outfit, count):
    """Pairs of each garment that cross: with others of its outfit, with itself; [count,2]."""
    found = np.zeros((count, 2), int)
    for m, o in itertools.combinations(range(len(faces)), 2):
        if outfit[m] != outfit[o] or set(faces[m]) & set(faces[o]):
            continue
        if crosses(points[faces[m]], points[faces[o]]):
            if garment[m] == garment[o]:
                found[garment[m], 1] += 1
            else:
                found[[garment[m], garment[o]], 0] += 1
    return found


def carried_together(vertices, predicted, faces, samples, outfit_of_vertex, sample_offsets, motions, reach=0.2):
    """Positions [V,3]; `motions` are the affine motions of the samples, matrices [S,3,3] and offsets [S,3]."""
    linear, offset = motions
    centre = vertices[faces[samples]].mean(1)

    def moved(x, outfit, b):
        at = slice(sample_offsets[outfit], sample_offsets[outfit + 1])
        w = np.clip(1 - ((x - centre[at]) ** 2).sum(1) / reach**2, 0, None) ** 2
        return (w[:, None] * (linear[at] @ x + b[at])).sum(0) / w.sum()

    missing = [
        predicted[faces[f]].mean(0) - moved(centre[j], outfit_of_vertex[faces[f][0]], offset)
        for j, f in enumerate(samples)
    ]
    corrected = offset + np.array(missing)
    return np.array(
        [x if outfit < 0 else moved(x, outfit, corrected) for x, outfit in zip(vertices, outfit_of_vertex, strict=True)]
    )
