"""What can be missing for a table."""

from __future__ import annotations


class OptionMissing(ValueError):
    """An option that the evaluation needs was not given."""


class DataLacks(ValueError):
    """The data set has nothing that this table compares; says which command makes it."""
