"""Sound files of data sets, motions, recordings and networks, and what their readers make of a file."""

from __future__ import annotations

import functools
import json
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.bodies.clips import clip_frames, read_clip, resampled
from warpgarment.io.disk.cache import remembered
from warpgarment.io.npz import write_npz
from warpgarment.training.data.card_facts import Facts as CardFacts
from warpgarment.training.data.sequence import Sequence, write_sequence
from warpgarment.training.data.set_manifest import read_set_manifest, write_set_manifest
from warpgarment.training.data.verify import verify
from warpgarment.training.readers.formats import detect, read_recording
from warpgarment.training.readers.matlab import read_mat
from warpgarment.training.readers.pc16 import read_pc16
from warpgarment.training.readers.unpickle import read_pickle

from .shapes import FRAMES, box, moved, transforms, tube

Facts = dict[str, Any]


def add_sequence(folder: Path, number: int = 0) -> Path:
    """A sequence of a data set: a tube about a box that slides."""
    (cloth, faces), (solid, sides) = tube(), box()
    arrays = {
        "garment_rest_vertices": cloth, "garment_faces": faces, "pins": np.arange(2, dtype=np.int32),
        "garment_vertices": moved(cloth + np.float32(0.001 * number)), "body_rest_vertices": solid, "body_faces": sides,
        "collider_faces": np.arange(len(sides)) < 11, "bone_indices": np.zeros((len(solid), 2), np.uint8),
        "bone_weights": np.full((len(solid), 2), 0.5, np.float32), "bone_transforms": transforms(),
        "wind": np.zeros((FRAMES, 3), np.float32),
    }  # fmt: skip
    manifest = {
        "status": "good", "reason": "", "split": "train", "motion": f"clip {number}", "garment": "tube",
        "category": "dress", "body": {"kind": "box", "height": 1.7}, "seed": 0, "fps": 30.0, "frames": FRAMES,
        "figures": {"stretch": 0.1, "crossings": False}, "versions": {"numpy": "2"}, "number": number,
        "rejected_attempts": [{"reason": "frame 1: too deep", "motion": "clip"}],
        "garments": [{"name": "tube", "category": "dress", "material": {"density": 0.2}}],
    }  # fmt: skip
    write_sequence(folder, arrays, manifest)
    return folder


def add_set(folder: Path) -> Path:
    """A data set of one sequence."""
    add_sequence(folder / "sequence_0")
    configuration = {"recipe": "cloth3d", "seed": 0, "held_out": ["skirt"], "teacher": "newton", "clips": None}
    write_set_manifest(folder, configuration, {"substeps": 20}, numbers=range(1), command="warpgarment generate")
    return folder


def sequence(folder: Path) -> Facts:
    """What training reads of a sequence. Garments with numbers that are not finite are for it to find."""
    found = Sequence.load(folder)
    moving, wind = found.body(), found.wind
    facts = {"vertices": found.garment.vertices, "faces": found.garment.faces, "fps": found.fps, "frames": len(found)}
    facts |= {"body": moving.vertices, "not checked": found.vertices, "names": [layer.name for layer in found.layers]}
    return facts | ({} if wind is None else {"not checked either": wind})


def checked_set(folder: Path) -> Facts:
    """What `dataset verify` says."""
    report = verify(folder)
    text = str(report) + json.dumps(report.as_dict())
    return {"problems": [f"{p.where}: {p.what}" for p in report.problems], "frames": report.frames, "text": bool(text)}


def card(folder: Path) -> Facts:
    """What `dataset card` reads, and the text that it writes of it."""
    from collections import Counter

    from warpgarment.training.data.card_page import page

    facts = CardFacts.of(folder)
    text = page(facts, {}, Counter(str(m.get("reason")) for m in facts.rejected)) if facts.good else ""
    return {"page": re.sub(r"[\d.,]+ MB, [\d,]+ bytes", "", text)}  # which count the manifests too


def set_manifest(folder: Path) -> Facts:
    """What is read of `set.json` before a set is continued."""
    found = read_set_manifest(folder) or {}
    return {"text": json.dumps(found, sort_keys=True)}


def clip(path: Path) -> Facts:
    """A motion, resampled as `generate` does it."""
    found, frames = read_clip(path), clip_frames(path)
    if found.fps * len(found) < 1e5:
        again = resampled(found, 30.0)
        assert len(again) == frames, f"{len(again)} frames, the header says {frames}"
    return {"offsets": found.offsets, "rotations": found.rotations, "root": found.root, "fps": found.fps}


def write_bvh(folder: Path) -> Path:
    """A chain of three joints."""
    head = """HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 20 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Head
    {
      OFFSET 0 30 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 10 0
      }
    }
  }
}
MOTION
"""
    rows = [" ".join(str(round(0.5 * t + 0.1 * k, 3)) for k in range(12)) for t in range(FRAMES)]
    (folder / "a.bvh").write_text(f"{head}Frames: {FRAMES}\nFrame Time: 0.0083333\n" + "\n".join(rows) + "\n")
    return folder / "a.bvh"


def write_amass(folder: Path) -> Path:
    """AMASS's arrays, and some that are not read."""
    poses = np.linspace(-0.5, 0.5, FRAMES * 156).reshape(FRAMES, 156)
    write_npz(folder / "a.npz", {
        "poses": poses, "trans": poses[:, :3], "mocap_framerate": np.array(120.0), "gender": np.array("female"),
        "betas": np.zeros(16),
    })  # fmt: skip
    return folder / "a.npz"


def recording(path: Path) -> Facts:
    """A sample of a public data set, in the format that is found by its content."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = read_recording(path, **({"root": path} if (path / "meta.json").exists() else {}))
    facts: Facts = {"format": detect(path), "fps": found.fps, "frames": len(found)}
    for k, piece in enumerate(found.garments):
        facts |= {f"vertices {k}": piece.vertices, f"rest {k}": piece.rest.vertices, f"faces {k}": piece.rest.faces}
    if found.poses is not None:
        facts |= {"rotations": found.poses.rotations, "trans": found.poses.trans, "betas": found.poses.betas}
    if found.wind is not None:
        facts["wind"] = found.wind
    return facts | {f"material {k}": np.array(list(vars(m).values())) for k, m in enumerate(found.materials) if m}


def write_vto(folder: Path, protocol: int = 4) -> Path:
    """A sequence of VTO."""
    cloth, faces = tube()
    data = {
        "vertices": moved(cloth), "faces": faces, "pose": np.zeros((FRAMES, 72)), "translation": np.zeros((FRAMES, 3)),
        "shape": np.zeros((FRAMES, 10)), "sequence": "07_02", "subject": "07",
    }  # fmt: skip
    (folder / "tshirt_0.pkl").write_bytes(pickle.dumps(data, protocol=protocol))
    return folder / "tshirt_0.pkl"


def write_vto_npz(folder: Path) -> Path:
    """The same as arrays."""
    cloth, faces = tube()
    write_npz(folder / "tshirt_0.npz", {
        "vertices": moved(cloth), "faces": faces, "rest_vertices": cloth, "pose": np.zeros((FRAMES, 72)),
        "translation": np.zeros((FRAMES, 3)), "shape": np.zeros(10), "sequence": np.array("07_02"),
    })  # fmt: skip
    return folder / "tshirt_0.npz"


def write_dlayers(folder: Path) -> Path:
    """A sample of D-LAYERS, two garments and wind; the clip is in the folder too."""
    _, faces = tube()
    human = {"gender": "female", "betas": [0.5] * 10, "motion_path": "clip.pkl", "seq_start": 0, "seq_end": FRAMES}
    human |= {"frame_start": 1, "scale": 10.0, "collision": {"friction": 60.0}}
    stiff = {"mass": 0.4, "tension_stiffness": 40.0, "bending_stiffness": 30.0, "self_friction": 50.0}
    pivots = [{"frame_start": 2, "rotation_quaternion": [1.0, 0.0, 0.0, 0.0], "strength": 200.0}]
    names = ("jacket_hood", "dress")
    meta = {"human": human, "garment": [{"name": n, "cloth": stiff} for n in names], "wind": [{"pivot_list": pivots}]}
    (folder / "meta.json").write_text(json.dumps(meta))
    for name, radius in zip(names, (0.4, 0.36), strict=True):
        worn, _ = tube(radius=radius)
        data = {"vertices": 10 * moved(worn), "faces": faces, "tpose": 10 * worn}
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(data, protocol=3))
    clip = {"poses": np.zeros((FRAMES, 72)), "trans": np.zeros((FRAMES, 3))}
    (folder / "clip.pkl").write_bytes(pickle.dumps(clip, protocol=2))
    return folder


def write_cloth3d(folder: Path) -> Path:
    """A sample of CLOTH3D."""
    from scipy.io import savemat

    cloth, faces = tube()
    outfit = {"Top": {"fabric": "cotton"}}
    info = {"poses": np.zeros((72, FRAMES)), "trans": np.zeros((3, FRAMES)), "shape": np.zeros(10), "gender": 1.0}
    savemat(folder / "info.mat", info | {"zrot": 0.5, "outfit": outfit, "tightness": np.array([0.5, -1.0])})
    lines = [f"v {x} {y} {z}" for x, y, z in cloth.tolist()] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()
    ]
    (folder / "Top.obj").write_text("\n".join(lines) + "\n")
    write_pc16(folder).rename(folder / "Top.pc16")
    return folder


def write_pc16(folder: Path) -> Path:
    """A point cache of 16-bit floats."""
    import struct

    cloth, _ = tube()
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(cloth), 0.0, 1.0, FRAMES)
    (folder / "a.pc16").write_bytes(head + moved(cloth).astype("<f2").tobytes())
    return folder / "a.pc16"


def pc16(path: Path) -> Facts:
    """A point cache; its positions are checked by those who read it."""
    return {"not checked": read_pc16(path)}


def write_mat(folder: Path) -> Path:
    """Variables of MATLAB."""
    from scipy.io import savemat

    outfit = {"Top": {"fabric": "cotton"}}
    savemat(folder / "info.mat", {"poses": np.zeros((72, 2)), "outfit": outfit, "gender": 1.0}, do_compression=True)
    return folder / "info.mat"


def mat(path: Path) -> Facts:
    """Variables by name; what they hold is checked by those who read them."""
    return {"names": sorted(read_mat(path, ("poses", "outfit", "gender"), ("poses",)))}


def write_pickle(folder: Path) -> Path:
    """A pickle of plain data of many kinds."""
    data = {"a": [1, 2.5, None, True, b"x", "y", (1, 2)], "b": np.arange(6).reshape(2, 3), "c": np.float64(2.0)}
    (folder / "a.pkl").write_bytes(pickle.dumps(data | {"d": np.array(["x", "yy"]), "e": {1: {}}}, protocol=4))
    return folder / "a.pkl"


def pickled(path: Path) -> Facts:
    """The plain data of a pickle."""
    return {"text": repr(read_pickle(path))[:2000]}


KEPT = {"distance": ("float32", (None, 3)), "index": ("int64", (None,))}


def _computed() -> dict[str, np.ndarray]:
    return {"distance": np.arange(30, dtype=np.float32).reshape(10, 3), "index": np.arange(5)}


def write_kept(folder: Path) -> Path:
    """What takes long to compute, kept on disk."""
    kept(folder)
    return folder


def kept(folder: Path) -> Facts:
    """The same from the cache, or computed again: it never differs."""
    import os

    os.environ["WARPGARMENT_CACHE"] = str(folder)
    return dict(remembered("fuzz", [1], KEPT, _computed))


@functools.cache
def _network() -> Any:
    import torch

    from warpgarment.nn.config import STATISTICS, NetworkConfig
    from warpgarment.nn.faces.network import ManifoldAwareTransformer

    torch.manual_seed(0)
    torch.set_num_threads(1)
    small = {"embedding": 16, "layers": 2, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "history": 3}
    network = ManifoldAwareTransformer(NetworkConfig(**small))
    network.set_statistics({name: torch.rand(length) + 0.5 for name, length in STATISTICS.items()})
    return network


def write_checkpoint(folder: Path) -> Path:
    """A network in one file."""
    from warpgarment.nn import checkpoint

    checkpoint.save(_network(), folder / "a.safetensors", notes={"steps": 12, "training": {"lr": 1e-3}})
    return folder / "a.safetensors"


def write_shards(folder: Path) -> Path:
    """A network in several files."""
    from warpgarment.nn import checkpoint

    checkpoint.save(_network(), folder / "net", notes={"steps": 12}, max_shard_bytes=20_000)
    return folder / "net"


def network(path: Path) -> Facts:
    """A network, its settings and its notes."""
    from warpgarment.nn import checkpoint

    config, notes = checkpoint.read_metadata(path)
    found = checkpoint.load(path)
    facts: Facts = {name: tensor.numpy() for name, tensor in found.state_dict().items()}
    return facts | {"config": repr(config), "notes": json.dumps(notes, sort_keys=True)}


_PROGRESS = {"step": 3, "elapsed": 1.5, "best": 2.5, "pool_step": 2, "recent": [[0.5, 0.25]]}


def write_state(folder: Path) -> Path:
    """Where a training stands."""
    from warpgarment.training.train import state

    network, average, optimizer = _in_training()
    state.save(folder / "state.safetensors", network, average, optimizer, {}, _PROGRESS)
    return folder / "state.safetensors"


def _in_training() -> tuple[Any, Any, Any]:
    import copy

    import torch

    from warpgarment.training.train import state

    network = copy.deepcopy(_network())
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)
    for parameter in network.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    return network, state.Average(network, 0.9), optimizer


def training_state(path: Path) -> Facts:
    """A training that goes on."""
    from warpgarment.training.train import state

    network, average, optimizer = _in_training()
    extra, progress = state.load(path, network, average, optimizer)
    facts: Facts = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    facts |= {f"average.{name}": tensor.numpy() for name, tensor in average.network.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        facts |= {f"{index}.{name}": np.asarray(value) for name, value in values.items()}
    facts |= {name: tensor.numpy() for name, tensor in extra.items()}
    facts |= {f"recent {k}": np.array(row) for k, row in enumerate(progress.get("recent", []))}
    return facts | {"step": progress["step"] + 0, "updates": average.updates + 0, "elapsed": progress["elapsed"] + 0.0}


def write_interactions(folder: Path) -> Path:
    """A sequence and what training keeps beside it."""
    add_sequence(folder / "data" / "sequence_0")
    interactions(folder)
    return folder


def interactions(folder: Path) -> Facts:
    """The same from the cache, or computed again: it never differs."""
    from warpgarment.training.samples.interactions import cached

    place = folder / "data" / "sequence_0"
    interaction, geodesics = cached(Sequence.load(place), place, folder / "cache")
    return {"interaction": np.array(interaction), "not checked": np.array(geodesics)}
