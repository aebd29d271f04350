"""Checkpoints of several files: they come back whole, and parts that do not belong together are refused."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from warpgarment.errors import CheckpointError
from warpgarment.nn import checkpoint, shards
from warpgarment.nn.config import STATISTICS, NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer

LIMIT = 14_000  # bytes; the network below comes in three shards then


def network(seed: int = 0) -> ManifoldAwareTransformer:
    """Random weights and statistics."""
    torch.manual_seed(seed)
    made = ManifoldAwareTransformer(
        NetworkConfig(embedding=16, layers=2, feed_forward=16, heads=2, manifold_heads=1, history=3)
    )
    made.set_statistics({name: torch.rand(length) + 0.5 for name, length in STATISTICS.items()})
    return made


@pytest.fixture
def folder(tmp_path):
    """A good checkpoint of several shards."""
    checkpoint.save(network(), tmp_path / "net", notes={"steps": 12}, max_shard_bytes=LIMIT)
    return tmp_path / "net"


def parts(folder):
    """The shards of a folder, in order."""
    return sorted(folder.glob("*.safetensors"))


def rewrite(path, change):
    """Lets `change` edit the tensors of a shard; its metadata stay."""
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path, metadata=metadata)


def edit_index(folder, change):
    """Lets `change` edit the index."""
    path = folder / shards.INDEX
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))


def test_round_trip(folder):
    """A network in shards would not be the one that was saved. Exact; in bfloat16 it is the single file's network."""
    made = network()
    loaded = checkpoint.load(folder)
    assert loaded.config == made.config
    assert not loaded.training
    assert all(torch.equal(tensor, loaded.state_dict()[name]) for name, tensor in made.state_dict().items())
    assert checkpoint.read_metadata(folder) == (made.config, {"steps": 12})
    assert checkpoint.find(folder) == folder
    half, one = folder.parent / "half", folder.parent / "half.safetensors"
    checkpoint.save(made, half, dtype=torch.bfloat16, max_shard_bytes=LIMIT)
    checkpoint.save(made, one, dtype=torch.bfloat16)
    loaded, wanted = checkpoint.load(half).state_dict(), checkpoint.load(one).state_dict()
    assert all(torch.equal(tensor, loaded[name]) for name, tensor in wanted.items())


def test_layout_is_that_of_hugging_face(folder):
    """Other tools would not find the tensors. Read as the layout says, with safetensors alone."""
    index = json.loads((folder / "model.safetensors.index.json").read_text())
    files = parts(folder)
    count = len(files)
    assert count == 3
    assert [file.name for file in files] == [f"model-{k:05d}-of-{count:05d}.safetensors" for k in range(1, count + 1)]
    assert {entry.name for entry in folder.iterdir()} == {file.name for file in files} | {shards.INDEX}
    wanted = network().state_dict()
    assert index["weight_map"].keys() == wanted.keys()
    for name, file in index["weight_map"].items():
        assert torch.equal(load_file(folder / file)[name], wanted[name])
    assert index["metadata"]["total_size"] == sum(tensor.numel() * 4 for tensor in wanted.values())
    for file in files:
        with safe_open(file, framework="pt") as opened:
            metadata = opened.metadata()
        assert (metadata["kind"], metadata["format"]) == (checkpoint.KIND, "pt")
        assert json.loads(metadata["config"])["embedding"] == 16
        assert json.loads(metadata["notes"]) == {"steps": 12}


@pytest.mark.parametrize("limit", [8_500, 9_000, 10_500, 13_000, 20_000, 40_000])
def test_no_file_is_larger_than_asked(tmp_path, limit):
    """A shard would not go through what it was made small for; headers count."""
    notes = {"remark": 'ümläut "quoted" \\ ' * 20}
    checkpoint.save(network(), tmp_path / "net", notes=notes, max_shard_bytes=limit)
    assert max(file.stat().st_size for file in parts(tmp_path / "net")) <= limit
    assert checkpoint.read_metadata(tmp_path / "net")[1] == notes


def test_one_shard_is_a_plain_file(tmp_path):
    """A small network would come with an index that nothing needs."""
    checkpoint.save(network(), tmp_path / "net", max_shard_bytes=10**6)
    assert [entry.name for entry in (tmp_path / "net").iterdir()] == ["model.safetensors"]
    assert checkpoint.find(tmp_path / "net") == tmp_path / "net" / "model.safetensors"
    assert torch.equal(checkpoint.load(tmp_path / "net").face_head.weight, network().face_head.weight)


def test_a_shard_too_small_for_a_tensor(tmp_path):
    """The limit would be broken without a word, or an empty folder would be left."""
    with pytest.raises(ValueError, match=r"max_shard_bytes is 2,000, too little for embed_faces\.weight alone"):
        checkpoint.save(network(), tmp_path / "net", max_shard_bytes=2_000)
    assert not list(tmp_path.iterdir())


def test_folders_are_whole_or_absent(folder, monkeypatch):
    """A full disk would leave shards of two networks in one folder."""
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    written = []

    def full_disk(tensors, metadata):
        if written:
            raise OSError("no space left on device")
        written.append(metadata)
        return b"half"

    monkeypatch.setattr(shards, "serialise", full_disk)
    with pytest.raises(OSError, match="no space"):
        checkpoint.save(network(1), folder, max_shard_bytes=LIMIT)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert [entry.name for entry in folder.parent.iterdir()] == ["net"]


def test_saving_again(folder):
    """Shards of the last network would stay among those of the next, or somebody's files would be deleted."""
    checkpoint.save(network(1), folder, max_shard_bytes=20_000)
    assert len(parts(folder)) == 2
    assert torch.equal(checkpoint.load(folder).face_head.weight, network(1).face_head.weight)
    (folder / "README.md").write_text("mine")
    with pytest.raises(FileExistsError, match=r"README\.md"):
        checkpoint.save(network(2), folder, max_shard_bytes=LIMIT)
    assert (folder / "README.md").read_text() == "mine"


def test_missing_shard(folder):
    """A download that stopped would end in a stack trace."""
    parts(folder)[1].unlink()
    with pytest.raises(CheckpointError, match=r"1 of 3 shards are missing \(first: model-00002-of-00003"):
        checkpoint.load(folder)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_truncated_shard(folder, share):
    """A shard cut short would be read as numbers."""
    path = parts(folder)[2]
    raw = path.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(CheckpointError, match="model-00003-of-00003"):
        checkpoint.load(folder)


@pytest.mark.parametrize("notes", [{"steps": 12}, {"steps": 13}])
def test_shard_of_another_run(folder, notes):
    """Half of one network and half of another would move garments, even where only the weights differ."""
    other = folder.parent / "other"
    checkpoint.save(network(1), other, notes=notes, max_shard_bytes=LIMIT)
    shutil.copy(parts(other)[1], parts(folder)[1])
    with pytest.raises(CheckpointError, match=r"model-00002-of-00003\.safetensors belongs to another checkpoint"):
        checkpoint.read_metadata(folder)


def test_foreign_shard(folder):
    """Any safetensors file of the right name would do."""
    save_file(load_file(parts(folder)[1]), parts(folder)[1])
    with pytest.raises(CheckpointError, match="belongs to another checkpoint"):
        checkpoint.load(folder)


def test_changed_tensor(folder):
    """A bit that flipped on the way, in a shard that otherwise looks right, would go unseen."""

    def flip(tensors):
        next(iter(tensors.values())).flatten()[0] += 1.0

    rewrite(parts(folder)[0], flip)
    with pytest.raises(CheckpointError, match="digest"):
        checkpoint.load(folder)


def test_tensor_in_two_shards(folder):
    """Which of two tensors is meant would be left to chance."""
    name, tensor = next(iter(load_file(parts(folder)[0]).items()))
    rewrite(parts(folder)[2], lambda tensors: tensors.update({name: tensor}))
    with pytest.raises(CheckpointError, match=rf"{name} is in two shards, model-00001.* and model-00003"):
        checkpoint.load(folder)


def test_tensor_that_is_nowhere(folder):
    """A tensor that is missing from its shard would stay random."""
    name = sorted(load_file(parts(folder)[1]))[0]
    rewrite(parts(folder)[1], lambda tensors: tensors.pop(name))
    with pytest.raises(CheckpointError, match=rf"1 tensors of .*not in their shards \(first: {name}\)"):
        checkpoint.load(folder)


@pytest.mark.parametrize(
    "name",
    ["../x.safetensors", "/etc/x.safetensors", "a/b.safetensors", "..\\x.safetensors", ".x.safetensors", "x.bin", 3],
)
def test_index_that_leaves_the_folder(folder, name):
    """An index from somewhere would make the library open any file on the machine."""
    shutil.copy(parts(folder)[0], folder.parent / "x.safetensors")
    edit_index(folder, lambda index: index["weight_map"].update({"face_head.bias": name}))
    with pytest.raises(CheckpointError, match=r"face_head\.bias is in .* no \.safetensors file of this folder"):
        checkpoint.load(folder)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        ("[1]", "not a JSON object"),
        ('{"metadata": {"total_size": 1}, "weight_map": {}}', "weight_map or metadata"),
        ('{"metadata": {}, "weight_map": {"a": "b.safetensors"}}', "weight_map or metadata"),
    ],
)
def test_index_that_cannot_be_read(folder, text, word):
    """A damaged index would end in a stack trace."""
    (folder / shards.INDEX).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(CheckpointError, match=rf"index\.json: .*{word}"):
        checkpoint.load(folder)


def test_index_that_does_not_fit(folder):
    """An index of another version of the network would be believed."""
    first, second = (sorted(load_file(file))[0] for file in parts(folder)[:2])
    good = (folder / shards.INDEX).read_text()
    edit_index(folder, lambda index: index["weight_map"].pop(first))
    with pytest.raises(CheckpointError, match=rf"holds {first}, .* does not list it"):
        checkpoint.load(folder)
    (folder / shards.INDEX).write_text(good)
    edit_index(folder, lambda index: index["weight_map"].update({second: parts(folder)[0].name}))
    with pytest.raises(CheckpointError, match=rf"holds {second}, .* says it is in model-00001"):
        checkpoint.load(folder)
    (folder / shards.INDEX).write_text(good)
    edit_index(folder, lambda index: index["metadata"].update(total_size=7))
    with pytest.raises(CheckpointError, match="gives 7 bytes"):
        checkpoint.load(folder)


def test_parts_by_themselves(folder):
    """One shard would be loaded as if it were a network, or a folder without index as several."""
    with pytest.raises(CheckpointError, match="is shard 2 of 3 of a checkpoint; name its folder"):
        checkpoint.load(parts(folder)[1])
    (folder / shards.INDEX).unlink()
    with pytest.raises(CheckpointError, match=r"index\.json, which says what its 3 shards hold, is missing"):
        checkpoint.load(folder)


def test_shards_of_another_config(folder):
    """A folder whose tensors do not fit its config would give a network that is half random."""
    for path in parts(folder):
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
        metadata["config"] = json.dumps(json.loads(metadata["config"]) | {"layers": 3})
        save_file(load_file(path), path, metadata=metadata)
    with pytest.raises(CheckpointError, match=r"missing \(first: layers\.2"):
        checkpoint.load(folder)
