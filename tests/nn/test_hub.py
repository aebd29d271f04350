"""Names of networks: their order of precedence, downloads from the Hugging Face Hub, and errors for unknown names."""

from __future__ import annotations

import fnmatch
import shutil
import sys
import types

import pytest
import torch

from warpgarment.errors import CheckpointError, MissingExtra
from warpgarment.nn import checkpoint, hub
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.sim.simulator import Simulator


def network(seed: int = 0) -> ManifoldAwareTransformer:
    """Random weights."""
    torch.manual_seed(seed)
    return ManifoldAwareTransformer(
        NetworkConfig(embedding=16, layers=2, feed_forward=16, heads=2, manifold_heads=1, history=3)
    )


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A stand-in for the Hub: repositories are folders of `server.root`, calls are kept in `server.calls`."""
    root, cache, calls = tmp_path / "server", tmp_path / "cache", []
    root.mkdir()

    def snapshot_download(repo_id, *, revision=None, allow_patterns=None, ignore_patterns=None):
        calls.append((repo_id, revision))
        source = root / repo_id / (revision or "main")
        if not source.is_dir():
            raise LookupError(f"404 Client Error for {repo_id}\nmore lines")
        target = cache / repo_id / (revision or "main")
        for path in source.rglob("*"):
            name = path.relative_to(source).as_posix()
            wanted = any(fnmatch.fnmatch(name, pattern) for pattern in allow_patterns or ["*"])
            if path.is_file() and wanted and not any(fnmatch.fnmatch(name, p) for p in ignore_patterns or []):
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target / name)
        target.mkdir(parents=True, exist_ok=True)
        return str(target)

    module = types.ModuleType("huggingface_hub")
    module.snapshot_download = snapshot_download
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    return types.SimpleNamespace(root=root, cache=cache, calls=calls)


@pytest.fixture
def nothing_here(tmp_path, monkeypatch):
    """A working folder without networks, and a package that ships `small` only."""
    (tmp_path / "work").mkdir()
    (tmp_path / "shipped").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path / "shipped")
    network(7).save(tmp_path / "shipped" / "small.safetensors")
    (tmp_path / "shipped" / "default.txt").write_text("small\n", encoding="utf-8")
    return tmp_path / "work"


def same(simulator: Simulator, wanted: ManifoldAwareTransformer) -> bool:
    """Whether a simulator has these weights."""
    return torch.equal(simulator.network.embed_faces.weight, wanted.embed_faces.weight)


def test_networks_are_fetched(server, nothing_here):
    """A repository would not give the network that lies there, or code and pickles would be downloaded along."""
    checkpoint.save(network(1), server.root / "ada/cloth/main", max_shard_bytes=14_000)
    checkpoint.save(network(2), server.root / "ada/cloth/v2/model.safetensors")
    for name in (
        "modeling.py",
        "pytorch_model.bin",
        "weights.pkl",
        "config.json",
        "README.md",
        "old/model.safetensors",
    ):
        path = server.root / "ada/cloth/main" / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    assert same(Simulator.from_pretrained("ada/cloth", "cpu"), network(1))
    assert same(Simulator.from_pretrained("ada/cloth@v2", "cpu"), network(2))
    assert server.calls == [("ada/cloth", None), ("ada/cloth", "v2")]
    fetched = {p.relative_to(server.cache / "ada/cloth/main").as_posix() for p in server.cache.rglob("main/**/*")}
    shards = {f"model-0000{k}-of-00003.safetensors" for k in (1, 2, 3)}
    assert fetched == shards | {"model.safetensors.index.json", "README.md"}


def test_a_local_path_wins(server, nothing_here):
    """What lies in the working folder would be overlooked for something from the network of the same name."""
    checkpoint.save(network(1), server.root / "ada/cloth/main/model.safetensors")
    checkpoint.save(network(3), nothing_here / "ada/cloth", max_shard_bytes=14_000)
    assert same(Simulator.from_pretrained("ada/cloth", "cpu"), network(3))
    checkpoint.save(network(4), nothing_here / "small/net.safetensors")
    assert same(Simulator.from_pretrained("small", "cpu"), network(4))
    shutil.rmtree(nothing_here / "small")
    assert same(Simulator.from_pretrained("small", "cpu"), network(7))
    assert server.calls == []


@pytest.mark.parametrize(
    "name",
    ["large", "out/run/best", "ada/cloth.safetensors", "./ada/cloth", "/ada/cloth", "ada/..", "a/b@../c", "a b/c"],
)
def test_names_that_are_no_repository(server, nothing_here, name):
    """A path with a typing error would be sent to somebody's server."""
    with pytest.raises(CheckpointError, match=r"neither a file, a folder, nor one that ships \(small\)"):
        Simulator.from_pretrained(name, "cpu")
    assert server.calls == []


def test_repositories_that_are_not_there(server, nothing_here):
    """Another library's stack trace would not say what was tried."""
    with pytest.raises(CheckpointError) as caught:
        Simulator.from_pretrained("ada/typo", "cpu")
    assert str(caught.value) == (
        "no network 'ada/typo': neither a file, a folder, nor one that ships (small); nor could it be fetched from the "
        "Hugging Face Hub (LookupError: 404 Client Error for ada/typo)"
    )


def test_repositories_without_a_network(server, nothing_here):
    """A repository of pickles would be opened, or the error would name a cache folder that the user does not know."""
    (server.root / "ada/pickles/main").mkdir(parents=True)
    (server.root / "ada/pickles/main/pytorch_model.bin").write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"ada/pickles on the Hugging Face Hub holds no network: .* found none"):
        Simulator.from_pretrained("ada/pickles", "cpu")


def test_the_extra_is_named(nothing_here, monkeypatch):
    """Without huggingface-hub, a mistyped folder or a repository would end in a stack trace."""
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)  # as if it were not installed
    with pytest.raises(
        MissingExtra, match=r"no network 'out/run': neither .* pip install .warpgarment\[hub\]"
    ) as caught:
        Simulator.from_pretrained("out/run", "cpu")
    assert caught.value.extra == "hub"
    assert same(Simulator.from_pretrained("small", "cpu"), network(7))


def test_default_depends_on_the_device(nothing_here, tmp_path, monkeypatch):
    """A GPU would run the small network although the large one is there, or a CPU the large one."""
    ships = tmp_path / "shipped"
    for gpu in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda gpu=gpu: gpu)
        for device in (None, "cpu", "cuda", torch.device("cuda", 1)):
            assert checkpoint.find("default", device=device) == ships / "small.safetensors"
    checkpoint.save(network(8), ships / "base", max_shard_bytes=14_000)
    for gpu in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda gpu=gpu: gpu)
        assert checkpoint.find("default", device="cpu") == ships / "small.safetensors"
        assert checkpoint.find("default", device="cuda:0") == ships / "base"
        assert checkpoint.find("default", device=torch.device("cuda", 1)) == ships / "base"
        assert checkpoint.find("default") == ships / ("base" if gpu else "small.safetensors")
        assert checkpoint.find("small", device="cuda") == ships / "small.safetensors"
    assert same(Simulator.from_pretrained("default", "cpu"), network(7))
    assert same(Simulator.from_pretrained("base", "cpu"), network(8))


def test_only_data_is_asked_for():
    """Patterns would let code or pickles through. Names that repositories of networks hold."""
    allowed = [n for n in (
        "model.safetensors", "model-00001-of-00002.safetensors", "model.safetensors.index.json", "README.md", "a.py",
        "pytorch_model.bin", "model.pt", "model.pkl", "config.json", "tokenizer.json", "x.npz", "requirements.txt",
    ) if any(fnmatch.fnmatch(n, p) for p in hub.WANTED)]  # fmt: skip
    assert allowed == [
        "model.safetensors", "model-00001-of-00002.safetensors", "model.safetensors.index.json", "README.md",
    ]  # fmt: skip


@pytest.mark.parametrize(("shard", "files"), [(14_000, 4), (2**20, 1)])
def test_the_hubs_own_tools_read_a_folder(tmp_path, shard, files):
    """A published network opens here alone: the index, the names or the headers of its shards are not those that other
    programs expect. Bit for bit, by the loader of huggingface-hub (extra `hub`), with no key missing or left over."""
    theirs = pytest.importorskip("huggingface_hub")
    ours, other = network(5), network(6)
    written = checkpoint.save(ours, tmp_path / "net", max_shard_bytes=shard)
    assert len(list((tmp_path / "net").iterdir())) == files, written
    theirs.load_torch_model(other, tmp_path / "net", strict=True)
    for name, tensor in ours.state_dict().items():
        assert torch.equal(other.state_dict()[name], tensor), name
    found = {}
    for path in sorted((tmp_path / "net").glob("*.safetensors")):
        found |= theirs.load_state_dict_from_file(path)
    assert set(found) == set(ours.state_dict())
