"""Float64 NumPy twin of a whole LayersNet, for one outfit: dense, one patch and one head at a time."""

from __future__ import annotations

import numpy as np

UP = np.array([0.0, 1.0, 0.0])


def shortest(direction, target):
    """The rotation that turns a direction to a unit vector by the shortest way, from its axis and angle."""
    length = np.linalg.norm(direction)
    if length < 1e-6:
        return np.eye(3)
    d = direction / length
    axis, cosine = np.cross(d, target), d @ target
    sine = np.linalg.norm(axis)
    if 1.0 + cosine < 1e-4:
        return np.diag([1.0, -1.0, -1.0])
    if sine < 1e-12:
        return np.eye(3)
    k = axis / sine
    outer = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + sine * outer + (1.0 - cosine) * outer @ outer


def quaternion(direction):
    """That rotation to up as w, x, y, z, from half the angle."""
    length = np.linalg.norm(direction)
    if length < 1e-6:
        return np.array([1.0, 0.0, 0.0, 0.0])
    d = direction / length
    axis = np.cross(d, UP)
    angle = np.arctan2(np.linalg.norm(axis), d @ UP)
    axis = axis / max(np.linalg.norm(axis), 1e-30)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


def yaw_of(x, rest, faces):
    """Rotation about up that takes the heading out of a garment's vertices: the integral of Phi over the faces."""
    total = np.zeros((3, 3))
    for f in faces:
        edges = np.stack([rest[f[1]] - rest[f[0]], rest[f[2]] - rest[f[0]]], 1)
        now = np.stack([x[f[1]] - x[f[0]], x[f[2]] - x[f[0]]], 1)
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1])) / 2
        total += area * now @ np.linalg.pinv(edges)
    return total


class Twin:
    """A network's weights as float64 arrays."""

    def __init__(self, network):
        self.c = network.config
        self.w = {name: t.detach().double().numpy() for name, t in network.state_dict().items()}

    def linear(self, name, x):
        y = x @ self.w[f"{name}.weight"].T
        return y + self.w[f"{name}.bias"] if f"{name}.bias" in self.w else y

    def norm(self, name, x):
        y = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return y * self.w[f"{name}.weight"] + self.w[f"{name}.bias"]

    def encode(self, kind, x):
        x = np.maximum(self.linear(f"encoders.{kind}.0", x), 0)
        return np.maximum(self.linear(f"encoders.{kind}.2", x), 0)

    def start(self, name, x):
        return self.norm(f"{name}.3", self.linear(f"{name}.2", np.maximum(self.linear(f"{name}.0", x), 0)))

    def hidden(self, name, head, rotation):
        """R_h [w,w] of a head."""
        weight = self.w[f"{name}.weight"][head]
        if self.c.rotation == "published":
            return weight @ rotation @ weight.T
        basis = np.eye(len(weight))
        for axis in weight:
            basis = basis @ (np.eye(len(weight)) - 2 * np.outer(axis, axis) / (axis @ axis))
        inner = np.eye(len(weight))
        for k in range(len(weight) // 3):
            inner[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = rotation
        return basis @ inner @ basis.T

    def __call__(self, garments, clusters, past, body, body_faces, materials, wind, skin=None):
        """Positions at t+1 [V,3] and accelerations of patches [P,3].

        Args:
            garments: Rest vertices and faces of each garment of the outfit.
            clusters: Cluster of each face of each garment.
            past: For each garment, vertices at t, t-1, t-2.
            body: Vertices at t+1, t, t-1, t-2.
            body_faces: Faces of the body.
            materials: A row of the fields of `Material`, or None, for each garment.
            wind: Velocity of the air at t+1 and t, for each garment.
            skin: Rotations [3,V,3,3] and positions [3,V,3] of the garments as smooth skin at t+1, t, t-1; needed with
                `carried_by="body"`.
        """
        c = self.c
        past = [[np.asarray(x, float) for x in frames] for frames in past]
        body = [np.asarray(y, float) for y in body]
        roots = [y.mean(0) for y in body]
        turn = np.eye(3)
        if c.heading == "canonical":
            parts = zip(past, garments, strict=True)
            m = sum(yaw_of(x[0] - roots[1], np.asarray(rest, float), faces) for x, (rest, faces) in parts)
            angle = -np.arctan2(m[0, 2] - m[2, 0], m[0, 0] + m[2, 2])
            turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])

        def state(frames, shift):
            a, b, z = ((x - r) @ turn.T for x, r in zip(frames, shift, strict=True))
            return np.concatenate([a, a - b, b, b - z], 1)

        raw = [state(x, roots[1:]) for x in past]
        vertices = np.concatenate(raw)
        bodies = state(body[:3], roots[:3])
        carried = vertices @ np.kron([[0], [1], [0], [0]], np.eye(3)) + vertices[:, :3]
        base = carried @ turn + roots[0]  # inertia
        offsets = np.zeros((len(vertices), 0))
        if c.carried_by == "body":
            turns, places = skin
            new, old = np.concatenate([x[0] for x in past]), np.concatenate([x[1] for x in past])
            u = [
                np.stack([turns[0][v] @ turns[k][v].T @ (x[v] - places[k][v]) for v in range(len(x))])
                for k, x in ((1, new), (2, old))
            ]
            base = places[0] + u[0] + 0.75 * (u[0] - u[1])
            offsets = np.concatenate([u[0] @ turn.T, (u[0] - u[1]) @ turn.T], 1)
        normals = np.zeros_like(body[0])
        for f in body_faces:
            for corner in f:
                normals[corner] += turn @ np.cross(body[0][f[1]] - body[0][f[0]], body[0][f[2]] - body[0][f[0]])
        speed = [roots[k] - roots[k + 1] for k in range(3)]
        pull = [speed[0] - speed[1], speed[1] - speed[2]]
        gravity = [turn @ (np.array([0, -9.81 / c.fps**2, 0]) - p) for p in pull]

        # patches
        member, of_garment, start = [], [], 0
        for g, ((_rest, faces), cluster) in enumerate(zip(garments, clusters, strict=True)):
            for name in np.unique(cluster):
                member.append(np.unique(faces[cluster == name]) + start)
                of_garment.append(g)
            start += len(_rest)
        count, total = len(member), start
        rest = np.concatenate([np.asarray(r, float) for r, _ in garments])
        edges, start = set(), 0
        for r, faces in garments:
            for f in faces:
                edges |= {(int(f[i]) + start, int(f[j]) + start) for i in range(3) for j in range(3)}
            start += len(r)
        sets = [set(m.tolist()) for m in member]
        joined = np.array([[any((a, b) in edges for a in p for b in q) for q in sets] for p in sets])
        middle = np.stack([rest[m].mean(0) for m in member])
        own = np.array([min((np.linalg.norm(rest[v] - middle[p]), p) for p in range(count) if v in sets[p])[1]
                        for v in range(total)])  # fmt: skip
        patch = np.stack([vertices[m].mean(0) for m in member])
        offset = np.stack([offsets[m].mean(0) for m in member])

        # what is near
        def near_body(point, most):
            distance = np.linalg.norm(bodies[:, :3] - point, axis=1)
            return [j for j in np.argsort(distance, kind="stable")[:most] if distance[j] <= c.body_radius]

        def near_patches(p):
            distance = np.linalg.norm(patch[:, :3] - patch[p, :3], axis=1)
            allowed = [q for q in np.argsort(distance, kind="stable") if distance[q] <= c.patch_radius]
            return [q for q in allowed if not joined[p, q]][: c.patch_neighbours]

        # tokens: patches, body, attributes, wind, gravity
        def normal(x, about=None):
            x = (x - self.w["state_mean"]) / self.w["state_std"]
            if c.carried_by != "body":
                return x
            none = np.zeros((*x.shape[:-1], 6))
            more = none if about is None else (about - self.w["offset_mean"]) / self.w["offset_std"]
            return np.concatenate([x, more], -1)

        attributes = np.zeros((len(garments), 5))
        for g, row in enumerate(materials):
            if row is not None:
                row = np.maximum(np.asarray(row)[[0, 1, 2, 3, 5]], [1e-3, 1.0, 1.0, 1e-6, 1e-2])
                attributes[g] = np.log10(row / [0.3, 1e3, 1e3, 1e-3, 0.3])
        winds = np.stack([
            np.concatenate([
                np.concatenate([turn @ speed[k] * c.fps, turn @ pull[k] * c.fps**2 / 10, quaternion(turn @ wind[g][k]),
                                [np.linalg.norm(wind[g][k]) / 5]]) for k in range(2)
            ]) for g in range(len(garments))
        ])  # fmt: skip
        pulls = (np.stack(gravity) - self.w["acceleration_mean"]) / self.w["acceleration_std"]
        parts = {
            "patch": self.encode("state", normal(patch, offset)),
            "body": self.encode("state", normal(bodies)),
            "attributes": self.encode("attributes", attributes),
            "wind": self.encode("wind", winds),
            "gravity": self.encode("gravity", pulls.reshape(1, 6)),
        }
        kinds = {"patch": "state", "body": "state"}
        value = np.concatenate(list(parts.values()))
        sender = np.concatenate([self.start(f"senders.{kinds.get(k, k)}", x) for k, x in parts.items()])
        receiver = self.start("receiver", parts["patch"])
        first = dict(zip(parts, np.cumsum([0, *map(len, parts.values())]), strict=False))

        width = c.embedding // c.heads
        frames = {"body": [shortest(n, UP) for n in normals]}
        frames["wind"] = [shortest(turn @ wind[g][0], UP) for g in range(len(garments))]
        frames["gravity"] = [shortest(gravity[0], -UP)]
        order = ["body", "wind", "gravity"]
        sees = []  # for each patch, world and mesh senders: token, kind, number
        for p in range(count):
            world = [(q, "patch", q) for q in near_patches(p)]
            world += [(first["body"] + j, "body", j) for j in near_body(patch[p, :3], 16)]
            world += [(first["wind"] + of_garment[p], "wind", of_garment[p]), (first["gravity"], "gravity", 0)]
            mesh = [(q, "patch", q) for q in range(count) if joined[p, q]]
            if materials[of_garment[p]] is not None:
                mesh.append((first["attributes"] + of_garment[p], "attributes", of_garment[p]))
            sees.append((world, mesh))

        for block in range(c.layers):
            name = f"blocks.{block}"
            query = self.linear(f"{name}.query", value[:count])
            receiver = (
                self.linear(f"{name}.receive", value[:count]) + self.linear(f"{name}.remember", receiver) + receiver
            )
            sender = self.linear(f"{name}.send", value) + self.linear(f"{name}.remember", sender) + sender
            update = np.zeros((len(value), c.embedding))
            for p in range(count):
                for head in range(c.heads):
                    at = slice(head * width, (head + 1) * width)
                    senders = sees[p][0 if head < c.world_heads else 1]
                    scores, values = [], []
                    for token, kind, number in senders:
                        r, s = receiver[p, at], sender[token, at]
                        f = (r + s) / np.sqrt(((r - s) ** 2).sum() + 1e-6)
                        scores.append(2 * query[p, at] @ f / np.sqrt(width))
                        if kind in order:
                            k = order.index(kind)
                            turned = self.hidden(f"{name}.bases", head, frames[kind][number])
                            layer = self.w[f"{name}.turned_weight"][k, head]
                            f = turned.T @ np.maximum(layer @ turned @ f + self.w[f"{name}.turned_bias"][k, head], 0)
                        values.append(f)
                    share = np.exp(np.array(scores) - max(scores))
                    update[p, at] = share / share.sum() @ np.stack(values)
            update[:count] = self.linear(
                f"{name}.out", self.w[f"{name}.gain"] * update[:count] + self.w[f"{name}.offset"]
            )
            value = self.norm(f"{name}.attention_norm", value + update)
            deep = self.linear(f"{name}.contract", np.maximum(self.linear(f"{name}.expand", value), 0))
            value = self.norm(f"{name}.feed_forward_norm", value + deep)

        # decoder
        def decode(relative, p, point):
            near = near_body(point, 1)
            rotation = frames["body"][near[0]] if near else np.eye(3)
            heads = [self.hidden("bases", h, rotation) for h in range(c.heads)]

            def turned(x):
                return np.concatenate([heads[h] @ x[h * width : (h + 1) * width] for h in range(c.heads)])

            token = turned(parts["body"][near[0]]) if near else np.zeros(c.embedding)
            x = np.concatenate([(rotation @ relative.reshape(-1, 3).T).T.ravel(), turned(value[p]), token])
            for layer in (0, 2):
                x = np.maximum(self.linear(f"decoder.{layer}", x), 0)
            answer = rotation.T @ self.linear("decoder.4", x)
            return answer * self.w["acceleration_std"] + self.w["acceleration_mean"]

        after = np.zeros((total, 3))
        for v in range(total):
            away = np.linalg.norm(patch[:, :3] - vertices[v, :3], axis=1)
            closer = [q for q in np.argsort(away, kind="stable") if joined[own[v], q] and away[q] < away[own[v]]]
            chosen = [own[v], *closer[:3]]
            mine = normal(vertices[v], offsets[v])
            answers = [decode(mine - normal(patch[q], offset[q]), q, vertices[v, :3]) for q in chosen]
            after[v] = base[v] + turn.T @ np.mean(answers, axis=0)
        nothing = np.zeros(len(normal(vertices[0])))
        patches = np.stack([decode(nothing, p, patch[p, :3]) for p in range(count)])
        return after, patches
