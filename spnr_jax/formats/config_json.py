"""A training's config as JSON: nested objects of its fields, in which `model.method` names the network."""

import dataclasses
from typing import Any

from spnr_jax.config import NearPointsConfig, NetworkConfig, PaperConfig, SurfelConfig, TrainConfig, mismatch, types_of
from spnr_jax.errors import require

OURS: dict[str, type[NetworkConfig]] = {kind.method: kind for kind in (SurfelConfig, NearPointsConfig, PaperConfig)}
BASELINES = ("npbg", "point_nerf", "points2nerf")
GONE = {"model.encoder.scatter": "mean", "model.encoder.skip": "add"}
"""Fields of earlier versions, and the one value of each that is still computed."""


def to_dict(config: TrainConfig) -> dict:
    """Nested plain dict of a config."""
    values = dataclasses.asdict(config)
    return values | {"model": {"method": config.model.method} | values["model"]}


def from_dict(values: dict, kind: type = TrainConfig, path: str = "") -> Any:
    """Config from `to_dict`'s form; a field unknown, missing or of another type raises ValueError with its path."""
    kinds = types_of(kind)
    for name in [name for name in values if f"{path}{name}" in GONE]:
        kept = GONE[f"{path}{name}"]
        require(
            values[name] == kept,
            f"config field {path}{name} {values[name]!r}: this version knows {kept!r} alone; train the network again",
        )
    values = {name: value for name, value in values.items() if f"{path}{name}" not in GONE}
    for name in values:
        require(name in kinds, f"unknown config field {path}{name}; known: {', '.join(kinds)}")
    arguments = {}
    for name, expected in kinds.items():
        require(name in values, f"config field {path}{name} is missing")
        value = values[name]
        if dataclasses.is_dataclass(expected):
            require(isinstance(value, dict), f"config field {path}{name} holds {value!r}, which is no JSON object")
            if expected is NetworkConfig:
                expected = _network(value.get("method"), path)
                value = {field: inner for field, inner in value.items() if field != "method"}
            value = from_dict(value, expected, f"{path}{name}.")
        value = tuple(value) if isinstance(value, list) else value
        words = mismatch(value, expected)
        require(not words, f"config field {path}{name} must be {words}, got {value!r}")
        arguments[name] = value
    return kind(**arguments)


def _network(method: Any, path: str) -> type[NetworkConfig]:
    """Class of the config of a network; a baseline's is imported when a file names it."""
    require(
        method in (*OURS, *BASELINES), f"{path}model.method {method} is not one of {', '.join((*OURS, *BASELINES))}"
    )
    if method in OURS:
        return OURS[method]
    from spnr_jax.baselines.sizes import SIZES

    return SIZES[method]
