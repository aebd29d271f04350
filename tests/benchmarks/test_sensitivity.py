"""`python -m benchmarks.sensitivity`."""

from benchmarks.sensitivity.__main__ import main


def test_every_comparison_is_a_line(capsys):
    """A comparison would be left out, or a repeated rollout not be the same bits without anybody being told."""
    main(["--frames", "3", "--noise", "1e-5", "--seeds", "1", "--threads", "2"])
    lines = capsys.readouterr().out.splitlines()
    for name in ("dress", "tshirt"):
        assert f"{name}, again: the same bits" in lines
        assert f"{name}, in a batch of 4: the same bits" in lines
        assert any(line.startswith(f"{name}, 2 threads: ") for line in lines)
        assert any(line.startswith(f"{name}, noise of 1e-05 m, seed 0: ") and " mm apart" in line for line in lines)
    assert len(lines) == 8
