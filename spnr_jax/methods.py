"""The registry of methods (each a network with its functions), and training configs as JSON.

Your own file can add a method, and with it presets for `spnr train --preset`:

    register(Method(config=MyConfig, network=MyNetwork, presets=(mine_tiny,), label="Mine"))

`spnr train DATA RUN --methods my_method.py --preset mine_tiny` imports that file.  So do `spnr evaluate` and the other
commands with `--methods`, and `spnr_jax.load(RUN, methods="my_method.py")`.  Runs and weights files store the file's
name, but code is imported only if you name it.
"""

import dataclasses
import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from spnr_jax.config import LossConfig, NetworkConfig, PaperConfig, SurfelConfig, TrainConfig, mismatch, types_of
from spnr_jax.errors import UserError, first_line, require
from spnr_jax.presets import PRESETS

Function = Callable[..., Any]


def lazy(path: str) -> Function:
    """A function that imports "package.module:name" when it is first called, and calls it."""
    module, _, name = path.partition(":")

    def call(*arguments: Any, **named: Any) -> Any:
        return getattr(importlib.import_module(module), name)(*arguments, **named)

    return call


@dataclass(frozen=True, kw_only=True)
class Method:
    """A record of functions: all that training, `load`, evaluation, the commands and the viewer use of a network.

    Functions that are not given default to those for a Linen module, `network` (`method/inference.py`).
    """

    config: type[NetworkConfig]
    """The config class of the network; its `method` is the name of the method."""
    network: Function | None = None
    """(config) -> Linen module with `encode(cloud, train)`, `render(scene, camera)` and `__call__(cloud,
    camera, key, train)`.  Values that it sows into "losses" are added to the loss."""
    init: Function = lazy("spnr_jax.method.inference:init")
    """(key, config) -> fresh variables {"params", "batch_stats"}."""
    encode: Function = lazy("spnr_jax.method.inference:encode_object")
    """(variables, cloud, centre, scale, *, config) -> `Encoded` cloud in the box, unbatched."""
    render: Function = lazy("spnr_jax.method.inference:render_each")
    """(variables, volume, views, lights, *, config, quality) -> iterator of `Rendering`s, one per view."""
    prepare: Function = lazy("spnr_jax.training.batching:prepare")
    """(config, dataset, run, *, light) -> function (first step) -> iterator of batches.  ValueError if the data set
    does not suit; nothing is written before that function is called."""
    loss: Function = lazy("spnr_jax.method.inference:loss")
    """(variables, batch, key, *, config) -> (value, `Outcome`); pure, differentiated by the params in `variables`."""
    discriminator: Function | None = None
    """(config) -> Linen module (image, condition, mask) -> logits, for a loss with a discriminator."""
    takes_light: bool = False
    """Whether the light is an input; other networks know only the light that they were trained with."""
    companions: tuple[str, ...] = ()
    """Names of other networks of the package whose weights are stored in the variables, under these names."""
    presets: tuple[Callable[[], TrainConfig], ...] = ()
    """Functions that return training configs; a preset has the name of its function."""
    label: str = ""
    """Its name in tables and pictures."""
    source: str = ""
    """The file or module that registered it; empty for the package's methods."""


class Outcome(NamedTuple):
    """What a loss returns beside its value.

    The image (objects, views, ...) and the batch that it is compared with are only for a discriminator.
    """

    metrics: dict[str, Any]
    statistics: dict | None = None
    """Running statistics, updated by the batch; None leaves them unchanged."""
    image: Any = None
    batch: Any = None


METHODS: dict[str, Method] = {
    "surfels": Method(
        config=SurfelConfig,
        init=lazy("spnr_jax.method.surfel_method:init"),
        encode=lazy("spnr_jax.method.surfel_method:encode_object"),
        render=lazy("spnr_jax.method.surfel_method:render_each"),
        prepare=lazy("spnr_jax.training.gbuffers:prepare"),
        loss=lazy("spnr_jax.training.gbuffers:loss"),
        takes_light=True,
        companions=("densifier",),
        label="Surfels",
    ),
    "paper": Method(
        config=PaperConfig,
        network=lazy("spnr_jax.method.paper_method:PaperNetwork"),
        encode=lazy("spnr_jax.method.paper_method:encode_object"),
        render=lazy("spnr_jax.method.paper_method:render_each"),
        discriminator=lazy("spnr_jax.method.paper_method:discriminator"),
        label="The paper's network",
    ),
}


# entries of files that are no fields of a config: those of earlier versions, and those that name a network's class
EXTRA_FIELDS: dict[type, tuple[str, ...]] = {
    TrainConfig: ("trains", "pixel_stride"),
    LossConfig: ("pixel", "masked"),
    NetworkConfig: ("method", "source", "pixel_stride"),
}


class UnknownMethod(UserError):
    """A file names a method that is not registered."""


_included: set[Path | str] = set()  # modules and files that `include` imported


def register(method: Method) -> None:
    """Adds a method and its presets; ValueError if another method or preset has the same name."""
    name = method.config.method
    if name in METHODS:
        require(METHODS[name].config is method.config, f"there is a method {name} already; choose another name")
        return
    for preset in method.presets:
        require(preset.__name__ not in PRESETS, f"there is a preset {preset.__name__} already; choose another name")
    METHODS[name] = dataclasses.replace(method, source=method.config.__module__)
    PRESETS.update({preset.__name__: preset for preset in method.presets})


def include(source: Path | str) -> None:
    """Imports a module or a .py file that registers methods; a one-line ValueError if that fails."""
    name = str(source)
    location = Path(name).resolve() if name.endswith(".py") else name
    if location in _included:
        return
    before, folder = set(METHODS), str(Path.cwd())
    sys.path.insert(0, folder)  # its modules can be imported, as `python` has it and an installed command has not
    try:
        _import_file(location) if isinstance(location, Path) else importlib.import_module(location)
    except Exception as error:  # whatever a person's module raises
        raise UserError(f"--methods {name}: it cannot be imported ({first_line(error)})") from error
    finally:
        sys.path.remove(folder)
    registered = METHODS.keys() - before
    known = any(m.source.startswith(name) for m in METHODS.values())
    require(
        bool(registered) or known, f"--methods {name}: it registers no method; call spnr_jax.methods.register there"
    )
    for method in registered:
        METHODS[method] = dataclasses.replace(METHODS[method], source=name)
    _included.add(location)


def _import_file(path: Path) -> None:
    spec = importlib.util.spec_from_file_location(f"methods_of_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look for theirs there
    spec.loader.exec_module(module)


def network(config: NetworkConfig) -> Any:
    """The Linen module for a network's config; its code is imported at the first call."""
    found = method_of(config).network
    assert found is not None, f"{config.method} is no Linen module"
    return found(config)


def method_of(config: NetworkConfig) -> Method:
    """The method of a network; ValueError if it was not registered."""
    found = METHODS.get(config.method)
    if found is None or not isinstance(config, found.config):
        raise UnknownMethod(f"method {config.method} is not registered; call spnr_jax.methods.register first")
    return found


def to_dict(config: TrainConfig) -> dict:
    """A training config as a nested dict, with the method of its network and the file that registered it."""
    values, source = dataclasses.asdict(config), method_of(config.model).source
    named = {"method": config.model.method} | ({"source": source} if source else {})
    return values | {"model": named | values["model"]}


def from_dict(values: Any, kind: Any = TrainConfig, path: str = "") -> Any:
    """A training config from `to_dict`'s form; ValueError with the path of an unknown, missing or mistyped field."""
    place = f"config field {path[:-1]}" if path else "the config"
    require(isinstance(values, dict), f"{place} holds {values!r}, which is no JSON object")
    extra = EXTRA_FIELDS.get(kind, ())
    if kind is LossConfig and values.get("pixel") == "mse":  # then l1_weight was that of squared errors
        values = values | {"l1_weight": 0.0, "mse_weight": values.get("l1_weight")}
    if kind is TrainConfig and isinstance(values.get("model"), dict):  # the stride is one of networks now
        values = values | {"model": {"pixel_stride": values.get("pixel_stride", 1)} | values["model"]}
    if kind is NetworkConfig:
        kind = _find_config_class(values.get("method"), values.get("source"), path)
    kinds = types_of(kind)
    for name in values:
        known = name in kinds or name in extra
        require(known, f"unknown config field {path}{name}; known: {', '.join(kinds)}")
    arguments = {}
    for name, expected in kinds.items():
        require(name in values, f"config field {path}{name} is missing")
        value = values[name]
        if dataclasses.is_dataclass(expected):
            value = from_dict(value, expected, f"{path}{name}.")
        value = tuple(value) if isinstance(value, list) else value
        words = mismatch(value, expected)
        require(not words, f"config field {path}{name} must be {words}, got {value!r}")
        arguments[name] = value
    return kind(**arguments)


def _find_config_class(name: Any, source: Any, path: str) -> type[NetworkConfig]:
    """The config class of the network that a file names; nothing is imported for it."""
    if isinstance(name, str) and name in METHODS:
        return METHODS[name].config
    named = f"--methods {source}, or load(..., methods={source!r})" if source else "--methods and its file"
    raise UnknownMethod(f"{path}method {name} is not one of {', '.join(METHODS)}; for another give {named}")
