"""The command line: quick help, every verb, files in and out, and errors of one line with exit status 2."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support import meshes

from warpgarment import cli
from warpgarment.errors import OutputError
from warpgarment.io.disk.outputs import check_space
from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion


@pytest.fixture
def scene(tmp_path):
    """A skirt's OBJ in centimetres, a body's motion, and an untrained network, as files."""
    rest = meshes.icosphere(2, radius=0.2)
    lift = np.float32([0, 0.01, 0]) * np.arange(5, dtype=np.float32)[:, None, None]
    BodyMotion(rest.vertices + lift, rest.faces, 30.0).save(tmp_path / "body.npz")
    angle = 2 * np.pi * np.arange(16) / 16
    rings = [np.stack([24 * np.sin(angle), np.full(16, y), 24 * np.cos(angle)], 1) for y in (-8.0, 0.0, 8.0)]
    vertices = np.concatenate(rings)
    quads = [
        (r * 16 + k, r * 16 + (k + 1) % 16, (r + 1) * 16 + (k + 1) % 16, (r + 1) * 16 + k)
        for r in (0, 1)
        for k in range(16)
    ]
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
    lines += ["f " + " ".join(str(i + 1) for i in quad) for quad in quads]
    (tmp_path / "band.obj").write_text("\n".join(lines))
    torch.manual_seed(0)
    config = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2)
    checkpoint.save(ManifoldAwareTransformer(config), tmp_path / "network.safetensors")
    return tmp_path


def _error(capsys, *arguments: str) -> str:
    """Runs a verb that must fail; returns its only line on stderr."""
    assert cli.main(list(map(str, arguments))) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpgarment:")]
    assert len(lines) == 1
    assert "Traceback" not in lines[0]
    return lines[0]


def test_help_imports_nothing_heavy() -> None:
    """`warpgarment --help` would take seconds: it must not import torch, Warp, NumPy or SciPy."""
    code = "import sys; from warpgarment.cli import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(result.stderr.split()).isdisjoint({"torch", "warp", "numpy", "scipy", "tyro"})
    for verb in ("demo", "simulate", "generate", "dataset", "train", "evaluate", "bench", "view", "convert", "doctor"):
        assert f"\n  {verb}" in result.stdout


@pytest.mark.parametrize(
    ("load", "own", "expected"),
    [
        (3.0, {}, "1000"),
        (0.1, {}, None),
        (3.0, {"OMP_WAIT_POLICY": "ACTIVE"}, None),
        (3.0, {"GOMP_SPINCOUNT": "7"}, "7"),
    ],
)
def test_threads_do_not_spin_beside_other_work(load, own, expected, monkeypatch, capsys) -> None:
    """A step of training would take twenty times as long on a shared machine; or a user's own choice be overruled."""
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in own.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load), raising=False)
    assert cli.main(["convert", "no file", "no file either"]) == 2
    assert os.environ.get("GOMP_SPINCOUNT") == expected
    os.environ.pop("GOMP_SPINCOUNT", None)


@pytest.mark.parametrize("verb", list(cli.VERBS))
def test_every_verb_has_help(verb: str, capsys) -> None:
    """A verb whose module, options or function has moved fails only when somebody calls it."""
    with pytest.raises(SystemExit) as exit_:
        cli.main([verb, "--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert f"warpgarment {verb}" in text
    assert "_" not in "".join(w for w in text.split() if w.startswith("--"))  # kebab-case


def test_simulate_writes_the_motion(scene, capsys) -> None:
    """Wrong units, frames or files. The band's OBJ is in centimetres: frame 0 is those numbers over 100, to 1e-6 m."""
    out = scene / "band.npz"
    arguments = [
        "simulate",
        "band.obj",
        "body.npz",
        "--unit",
        "cm",
        "--weights",
        "network.safetensors",
        "--device",
        "cpu",
    ]
    arguments = [str(scene / a) if (scene / a).exists() else a for a in arguments]
    assert cli.main([*arguments, "--out", str(out)]) == 0
    written = GarmentMotion.load(out)
    lines = (scene / "band.obj").read_text().splitlines()
    positions = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float) / 100
    assert written.vertices.shape == (5, 48, 3)
    np.testing.assert_allclose(written.vertices[0], positions, atol=1e-6)
    assert np.isfinite(written.vertices).all()
    printed = capsys.readouterr().out
    assert "frames" in printed
    assert "deepest penetration [mm]" in printed

    # carried from the body's rest pose, 3 cm lower: a body that only shifts takes the garment along
    body = BodyMotion.load(scene / "body.npz")
    BodyMotion(body.vertices[:1] - np.float32([0, 0.03, 0]), body.faces).save(scene / "rest.npz")
    fitted = [*arguments, "--out", str(out), "--fit-rest", str(scene / "rest.npz"), "--frames", "2"]
    assert cli.main(fitted) == 0
    np.testing.assert_allclose(GarmentMotion.load(out).vertices[0], positions + np.array([0, 0.03, 0]), atol=1e-4)


def test_convert_keeps_positions(scene) -> None:
    """A format loses frames or vertices: npz, PC2, OBJ folder, USD, npz. OBJ is text of 6 digits or more: 1e-5 m."""
    for source, target in (("body.npz", "a.pc2"), ("a.pc2", "folder"), ("folder", "b.usda"), ("b.usda", "c.npz")):
        assert cli.main(["convert", str(scene / source), str(scene / target)]) == 0
    before, after = BodyMotion.load(scene / "body.npz"), BodyMotion.load(scene / "c.npz")
    np.testing.assert_allclose(after.vertices, before.vertices, atol=1e-5)
    np.testing.assert_array_equal(after.faces, before.faces)
    assert cli.main(["convert", str(scene / "body.npz"), str(scene / "d.npz"), "--fps", "60"]) == 0
    assert BodyMotion.load(scene / "d.npz").vertices.shape[0] == 9


def test_an_animation_becomes_part_of_a_data_set(scene, capsys) -> None:
    """Own simulations in other units cannot be trained on, or become a hundred times too large. 16-bit: 1e-5 m."""
    from warpgarment.training.data.sequence import Sequence

    rest = Garment.load(scene / "band.obj", unit="cm")
    lift = np.float32([0, 0.01, 0]) * np.arange(5, dtype=np.float32)[:, None, None]
    frames = rest.vertices + lift
    GarmentMotion(frames * 100, rest.faces, 30.0).save(scene / "cache.pc2")
    common = ["dataset", "import", scene / "cache.pc2", scene / "set" / "00000_band", "--body", scene / "body.npz"]
    common += ["--rest", scene / "band.obj"]
    text = _error(capsys, *common)
    assert "unit" in text  # a garment a hundred times the body's size
    assert not (scene / "set").exists() or not any((scene / "set").iterdir())
    units = ["--unit", "cm", "--body-unit", "m", "--split", "test", "--motion", "lift"]
    assert cli.main([*map(str, common), *units]) == 0
    sequence = Sequence.load(scene / "set" / "00000_band")
    np.testing.assert_allclose(sequence.vertices, frames, atol=1e-5)
    np.testing.assert_allclose(sequence.garment.vertices, rest.vertices, atol=1e-6)
    assert sequence.manifest["split"] == "test"
    assert sequence.manifest["motion"] == "lift"
    assert "recorded" not in sequence.manifest
    assert "training only" in _error(capsys, *common[:3], scene / "own", *common[4:], "--unrecorded", *units)
    assert cli.main([*map(str, [*common[:3], scene / "own", *common[4:], "--unrecorded"]), *units[:4]]) == 0
    assert Sequence.load(scene / "own").manifest["recorded"] is False
    capsys.readouterr()
    assert cli.main(["dataset", "verify", str(scene / "set"), "--json", str(scene / "report.json")]) == 0
    assert "1 sequences, 5 frames" in capsys.readouterr().out
    (scene / "set" / "00000_band" / "garment_faces.npy").write_bytes(b"")
    assert "garment_faces.npy" in _error(capsys, "dataset", "verify", scene / "set")


def test_view_draws_without_a_display(scene) -> None:
    """Pictures that need a window. 2 moments of half of 80 x 96 below a title; a film of 5 frames."""
    import imageio.v3 as iio
    import imageio_ffmpeg

    common = ["view", str(scene / "body.npz"), "--body", str(scene / "body.npz"), "--size", "80", "96"]
    assert cli.main([*common, "--out", str(scene / "v.png"), "--frames", "2"]) == 0
    assert iio.imread(scene / "v.png").shape == (48 + 30, 80, 3)
    assert cli.main([*common, "--out", str(scene / "v.mp4")]) == 0
    assert imageio_ffmpeg.count_frames_and_secs(str(scene / "v.mp4"))[0] == 5


def test_doctor_checks_itself(capsys) -> None:
    """A broken installation that looks whole, or the other way round."""
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert f"torch {torch.__version__}" in text
    assert "extra usd: installed" in text
    assert "self check on cpu: ok, 5 frames" in text


def test_bench_prints_a_row_per_stage(capsys) -> None:
    """Stages missing from the table, or a time of zero."""
    assert cli.main(["bench", "--frames", "1", "--batch", "2", "--device", "cpu"]) == 0
    lines = capsys.readouterr().out.splitlines()
    named = {line.split("  ")[0].strip(): line.split()[-1] for line in lines[3:]}
    for stage in ("features", "network", "singular values", "poisson", "collision"):
        assert float(named[stage]) > 0


def test_user_errors_are_one_line(scene, capsys) -> None:
    """A traceback instead of what is wrong and what to do."""
    body, band, out = scene / "body.npz", scene / "band.obj", scene / "out.usd"
    assert "no verb 'simulat'" in _error(capsys, "simulat")
    assert "nothing.obj" in _error(capsys, "simulate", scene / "nothing.obj", body, "--out", out)
    (scene / "broken.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    assert "MeshError" in _error(capsys, "simulate", scene / "broken.obj", body, "--out", out)
    text = _error(capsys, "simulate", band, body, "--unit", "cm", "--out", out, "--weights", "unheard-of")
    assert "CheckpointError" in text
    assert "unheard-of" in text
    assert "Formats" in _error(capsys, "simulate", band, body, "--out", scene / "out.fbx")
    assert "Formats" in _error(capsys, "convert", body, scene / "out.gif")
    assert "Formats" in _error(capsys, "view", body, "--out", scene / "out.gif")
    assert "no data set" in _error(capsys, "train", "--data", scene / "none", "--out", scene / "run", "--steps", "1")
    with pytest.raises(SystemExit) as exit_:  # options that don't go together: the parser's own message
        cli.main(["train", "--data", str(scene), "--out", str(scene / "run")])
    assert exit_.value.code == 2
    assert "steps or time_limit" in capsys.readouterr().err
    assert not out.exists()
    assert not (scene / "out.gif").exists()


def test_missing_extras_are_named(scene, capsys, monkeypatch) -> None:
    """An ImportError's traceback instead of the pip command."""
    monkeypatch.setitem(sys.modules, "pxr", None)
    text = _error(capsys, "convert", scene / "body.npz", scene / "body.usd")
    assert 'pip install "warpgarment[usd]"' in text

    import warpgarment.training.generate.run as generate

    def without_newton(_config):
        raise ModuleNotFoundError("No module named 'newton'", name="newton.solvers")

    monkeypatch.setattr(generate, "generate", without_newton)
    assert 'pip install "warpgarment[physics]"' in _error(capsys, "generate", "--out", scene / "data")


WRONG = [
    "simulate BAND BODY --out OUT --device cpu --unit yard",
    "simulate BAND BODY --out OUT --unit cm --device cpu --frames 0",
    "simulate BAND BODY --out OUT --device gpu",
    "simulate BAND BODY --out OUT --device cuda:99",
    "simulate BAND BODY --out OUT --device mps",
    "bench --device cuda:-2",
    "doctor --device tpu",
    "demo --out BAND --device cpu",
    "convert BODY DIR/sh.v1",
    "convert BODY BAND/x.npz",
    "convert BODY OUT --body-unit cm --unit ell",
    "convert BODY OUT --unit ell",
    "view BODY --out DIR/a.png --size 8 8",
    "view BODY --out DIR/a.png --size 90000 2000",
    "view BODY --out DIR/a.png --frames 100000000",
    "view BODY --out DIR/a.mp4 --azimuth inf",
    "view BODY --out BAND/a.png",
    "evaluate --data DIR --out BAND/x --device cpu",
    "evaluate --data DIR --out DIR/x --device gpu",
    "generate --out DIR/new --device gpu --bodies bundled",
    "generate --out DIR/new --device cuda:99 --bodies bundled",
    "generate --out BAND/x --bodies bundled",
    "generate --out DIR/new --bodies bundled --sequences 100000000000",
    "train --data DIR --out BAND/x --steps 1",
    "train --data DIR --out DIR/new --steps 1 --device gpu",
    "dataset import BAND BAND/x",
    "dataset import BODY DIR",
    "dataset card DIR --out BAND/x",
    "simulate BAND BODY --out DIR/band.pc2 --device cpu",
    "dataset verify DIR --json BAND/x.json",
]


@pytest.mark.parametrize("line", WRONG)
def test_mistakes_end_with_status_2(scene, capsys, line: str) -> None:
    """A traceback for what people mistype, or a picture of nothing: the status is 2 and nothing was written."""
    names = {"BAND": "band.obj", "BODY": "body.npz", "OUT": "out.npz", "DIR": "."}
    before = sorted(scene.rglob("*"))
    words = []
    for word in line.split():
        head, _, rest = word.partition("/")
        words.append(str(scene / names[head] / rest) if head in names else word)
    try:
        status = cli.main(words)
    except SystemExit as exit_:  # the parser's own
        status = exit_.code
    said = capsys.readouterr()
    assert status == 2
    assert said.err.strip()
    assert "Traceback" not in said.err
    assert "fault" not in said.err
    assert sorted(scene.rglob("*")) == before


def test_outputs_are_tried_before_the_simulation(scene, capsys, monkeypatch) -> None:
    """Hours of simulation are thrown away at their end, for a name or for a package that is not installed."""
    from warpgarment.sim.simulator import Simulator

    monkeypatch.setattr(Simulator, "rollout", lambda *_, **__: pytest.fail("simulated"))
    monkeypatch.setattr(Garment, "load", lambda *_, **__: pytest.fail("read"))
    (scene / "full.v1").mkdir()
    (scene / "full.v1" / "notes.txt").write_text("mine")
    (scene / "c.obj").mkdir()
    common = ["simulate", scene / "band.obj", scene / "body.npz", "--out"]
    assert "notes.txt" in _error(capsys, *common, scene / "full.v1")
    assert "c.obj" in _error(capsys, *common, scene / "c.pc2")
    assert "slash" in _error(capsys, *common, scene / "a.v1")
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert 'pip install "warpgarment[usd]"' in _error(capsys, *common, scene / "a.USDA")


def test_room_on_the_disk_is_asked_for(scene, capsys, monkeypatch) -> None:
    """Hours of work end with a full disk, where what is missing could be said at the beginning."""
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(10**12, 10**12 - 50, 50))
    out = scene / "new"
    words = ("simulate", scene / "band.obj", scene / "body.npz", "--device", "cpu", "--unit", "cm", "--out", out)
    for verb in (words, ("generate", "--bodies", "bundled", "--out", out)):
        assert re.search(r"about \d+ MB would be written, and 0 MB are free", _error(capsys, *verb))
        assert not out.exists()
    with pytest.raises(OutputError, match="about 9 MB would be written"):
        check_space(scene / "a" / "b", 9e6)
    check_space(scene / "a" / "b", 50)


def test_the_mesh_beside_a_point_cache_is_no_input(scene, capsys) -> None:
    """`--out band.pc2` writes its first frame to band.obj, and the garment of that name is lost."""
    BodyMotion.load(scene / "body.npz").save(scene / "walk.pc2")
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    words = ("simulate", scene / "band.obj", scene / "body.npz", "--device", "cpu", "--out", scene / "band.pc2")
    assert "band.obj is read" in _error(capsys, *words)
    assert "walk.obj is read" in _error(capsys, "convert", scene / "walk.pc2", scene / "walk.PC2")
    assert {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()} == before


def test_folders_of_any_name(scene) -> None:
    """Versions of a shot, `sh010.v002`, cannot be written: a slash says that a folder is meant."""
    assert cli.main(["convert", str(scene / "body.npz"), f"{scene}/sh.v1/"]) == 0
    assert len(list((scene / "sh.v1").glob("frame_*.obj"))) == 5
    assert cli.main(["convert", str(scene / "body.npz"), str(scene / "sh.v1")]) == 0


def test_a_film_that_cannot_be_encoded_is_an_error(scene, capsys, monkeypatch) -> None:
    """ffmpeg fails, at once or at the end, and `wrote film.mp4` is said of half a film where a whole one was."""
    film, program = scene / "film.mp4", scene / "ffmpeg"
    film.write_bytes(b"old")
    for body in ("cat > /dev/null; echo Disk quota exceeded >&2; exit 3", "echo Unknown encoder >&2; exit 1", "exit 0"):
        program.write_text(f"#!/bin/sh\n{body}\n")
        program.chmod(0o755)
        monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: str(program))
        text = _error(capsys, "view", scene / "body.npz", "--size", "80", "96", "--out", film)
        assert "OutputError" in text
        assert film.read_bytes() == b"old"
        assert not list(scene.glob(".*"))
    assert "film" in text
    program.unlink()
    assert "cannot be started" in _error(capsys, "view", scene / "body.npz", "--size", "80", "96", "--out", film)


def test_a_fault_of_the_program_says_so_and_keeps_its_traceback(scene, capsys, monkeypatch) -> None:
    """A bug would pass for a mistake of the user, or nobody could find it: status 1, and a file with the traceback."""

    def broken(*_, **__):
        raise KeyError("no such thing")

    monkeypatch.setattr(BodyMotion, "save", broken)
    assert cli.main(["convert", str(scene / "body.npz"), str(scene / "out.npz")]) == 1
    text = capsys.readouterr().err
    assert "fault" in text
    kept = Path(text.split("traceback is in ")[1].split("; ")[0].split(". Please")[0])
    assert "in broken" in kept.read_text()
    kept.unlink()


def test_exit_status_of_the_installed_command(scene) -> None:
    """The entry point swallows the status: scripts would not notice."""
    command = [sys.executable, "-m", "warpgarment", "nonsense"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
