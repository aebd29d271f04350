"""Training settings as text, name=value, and as plain values that identify a run."""

from __future__ import annotations

import dataclasses
import json
from typing import Any, TypeVar

from warpgarment.training.train.config import TrainConfig

OWN_OPTIONS = ("data", "out", "network", "overrides", "steps", "time_limit", "seed", "resume", "device", "threads")
HOW = ("data", "out", "cache", "resume", "device", "threads", "ahead")  # settings that do not affect the result

Config = TypeVar("Config")


class SettingError(ValueError):
    """A training setting that does not exist or has another kind of value."""


def with_settings(config: TrainConfig, settings: tuple[str, ...]) -> TrainConfig:
    """A training with other settings.

    Args:
        config: Configuration from which the result differs.
        settings: Settings, name=value each; names in groups have a dot, as in `noise.position=0.001`. Values are those
            of JSON, or text.

    Raises:
        SettingError: A setting does not exist or has another kind of value; the error names it and those that exist.
    """
    for text in settings:
        name, separator, value = text.partition("=")
        if not separator:
            raise SettingError(f"{text!r}: settings are name=value")
        if name in OWN_OPTIONS:
            raise SettingError(f"{name} is an option of its own (--{name.replace('_', '-')}), the same for all rows")
        config = _replaced(config, name.split("."), _value(value), text)
    return config


def described(config: TrainConfig) -> dict[str, Any]:
    """All settings on which the result depends, as plain values; groups have dots, and the network is resolved."""
    values = dataclasses.asdict(config)
    for name in (*HOW, "network", "overrides"):
        values.pop(name, None)
    values["network"] = config.network_config().as_dict()
    flat: dict[str, Any] = {}

    def add(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                add(f"{prefix}.{key}" if prefix else key, inner)
        else:
            flat[prefix] = value

    add("", values)
    return json.loads(json.dumps(flat, default=str))


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """The differences between two descriptions, in words."""
    names = sorted({*before, *now})
    missing = object()
    changed = [n for n in names if before.get(n, missing) != now.get(n, missing)]
    return [f"{n} was {json.dumps(before.get(n))}, is {json.dumps(now.get(n))}" for n in changed]


def _replaced(config: Config, path: list[str], value: Any, text: str) -> Config:
    names = [field.name for field in dataclasses.fields(config)]  # type: ignore[arg-type]
    if path[0] not in names:
        raise SettingError(f"{text!r}: there is no setting {path[0]!r}, only {', '.join(sorted(names))}")
    old = getattr(config, path[0])
    group = dataclasses.is_dataclass(old)
    if group != (len(path) > 1):
        what = f"a group: {path[0]}.NAME=value" if group else "not a group of settings"
        raise SettingError(f"{text!r}: {path[0]} is {what}")
    if group:
        value = _replaced(old, path[1:], value, text)
    elif old is not None and not _fits(value, old):
        raise SettingError(f"{text!r}: {path[0]} must be {type(old).__name__}, as in {old!r}")
    try:
        return dataclasses.replace(config, **{path[0]: value})  # type: ignore[type-var]
    except ValueError as error:
        raise SettingError(f"{text!r}: {error}") from error


def _fits(value: Any, old: Any) -> bool:
    if isinstance(old, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(old, bool)
    return isinstance(value, (int, float)) if isinstance(old, float) else isinstance(value, type(old))


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
