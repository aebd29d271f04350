"""Hostile files, made from seeds and given to every reader; see `python -m benchmarks.fuzz --help`."""
