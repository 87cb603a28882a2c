"""Trained networks and their file: one .npz with a config and the averaged weights as float16, a few megabytes at most.

    config              the TrainConfig as JSON, in bytes
    steps               of training
    params/.../kernel   one array each, named as in the Linen variables

The package includes the default network (docs/model_card.md) and its densifier (`method/densifier.py`), whose file
contains only weights.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import resources
from pathlib import Path

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from spnr_jax.config import NetworkConfig, TrainConfig
from spnr_jax.errors import UserError
from spnr_jax.formats.array_files import pack_arrays, read_arrays
from spnr_jax.formats.images import write_whole
from spnr_jax.method.model import Model
from spnr_jax.methods import UnknownMethod, from_dict, include, method_of, to_dict

# errors that readers raise for damaged headers
UNREADABLE = (ValueError, LookupError, TypeError, ArithmeticError, RecursionError)
ADVICE = "write one with `spnr export RUN`"
PACKAGED = "surfels"  # the network of the package, named as its preset


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A trained network: Linen variables with averaged weights, config, and number of steps."""

    config: TrainConfig
    variables: dict
    steps: int


def packaged_file(name: str = PACKAGED) -> Path:
    """A weights file of the package, by name: its network, or "densifier"."""
    return Path(str(resources.files("spnr_jax") / "pretrained" / f"{name}.npz"))


def add_companions(config: NetworkConfig, variables: dict, source: Path) -> dict:
    """The variables with those of companion networks (a densifier): the source's own, or else the package's."""
    folder = source.parent if source.is_file() else source
    own = {name: folder / f"{name}.npz" for name in method_of(config).companions}
    files = {name: path if path.is_file() else packaged_file(name) for name, path in own.items()}
    return variables | {name: read_variables(path) for name, path in files.items()}


def write_companions(folder: Path, trained: Trained) -> None:
    """Writes the network's companions, beside its weights."""
    for name in method_of(trained.config.model).companions:
        write_variables(folder / f"{name}.npz", trained.variables[name])


def keep_companions(run: Path, trained: Trained, say: Callable[[str], None]) -> None:
    """Writes the network's companions to a run folder, which trains with them.

    A file that is there stays; `say` gets a line if it has other weights.
    """
    for name in method_of(trained.config.model).companions:
        if not (path := run / f"{name}.npz").exists():
            write_variables(path, trained.variables[name])
        elif _pack_variables(read_variables(path)) != _pack_variables(trained.variables[name]):
            say(f"{path} is used, not the {name} of the initial weights; for that, stop, remove it and begin again")


def read_trained(source: Path | str | None, say: Callable[[str], None] = print) -> Trained:
    """The network of a run folder's newest checkpoint, of a file of weights, or of the package (None, or its name).

    ValueError, with what to do, if there is none; `say` gets a line for each broken checkpoint.
    """
    path = packaged_file() if source is None or str(source) == PACKAGED else Path(source)
    if path.suffix == ".npz":
        trained = read_weights(path)
        return replace(trained, variables=add_companions(trained.config.model, trained.variables, path))
    from spnr_jax.training import checkpoint, optimisation  # here: a file of weights is read without optimisers

    config, state = checkpoint.load_run(path, say)
    variables = add_companions(config.model, optimisation.averaged_variables(state), path)
    return Trained(config=config, variables=variables, steps=int(state.step))


def read_variables(path: Path) -> dict:
    """The variables of a file that contains only weights, float16 by name."""
    with path.open("rb") as file:
        return _as_variables(read_arrays(file))


def write_variables(path: Path, variables: Mapping) -> None:
    """Writes the file that `read_variables` reads."""
    write_whole(path, _pack_variables(variables))


def _pack_variables(variables: Mapping) -> bytes:
    """The content of that file, the same whatever the order of the names."""
    named = sorted(flatten_dict(variables, sep="/").items())
    return pack_arrays({name: np.asarray(values, np.float16) for name, values in named}, compressed=True)


def load(run: Path | str | None = None, methods: Path | str | None = None) -> Model:
    """The network of the package (None, or its name), of a run folder's newest checkpoint, or of a file.

    For your own method, `methods` names the .py file or module that registers it; it is never imported unasked.
    """
    if methods is not None:
        include(methods)
    trained = read_trained(run)
    return Model(config=trained.config.model, params=trained.variables)


def write_weights(path: Path, trained: Trained) -> None:
    """Writes the file; ValueError for weights that float16 cannot hold."""
    companions = method_of(trained.config.model).companions
    own = {name: tree for name, tree in trained.variables.items() if name not in companions}
    arrays = {name: np.asarray(values) for name, values in flatten_dict(own, sep="/").items()}
    for name, values in arrays.items():
        if not np.abs(values).max(initial=0) <= np.finfo(np.float16).max:
            raise UserError(f"{path}: {name} reaches {np.abs(values).max():.3g}, which float16 does not hold")
    halves = {name: values.astype(np.float16) for name, values in arrays.items()}
    described = np.frombuffer(json.dumps(to_dict(trained.config)).encode(), np.uint8)
    content: dict[str, np.ndarray] = {"config": described, "steps": np.array(trained.steps, np.int64)}
    write_whole(path, pack_arrays(content | halves, compressed=True))


def read_weights(path: Path) -> Trained:
    """The network of a file, in float32; ValueError that says what is wrong with it.

    The shapes of the weights are compared with the config's network, which takes a second of tracing; this is skipped
    for the package's own file.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file of weights; {ADVICE}")
    try:
        with path.open("rb") as file:
            arrays = read_arrays(file)
        described, steps = json.loads(arrays.pop("config").tobytes()), int(arrays.pop("steps"))
        config = from_dict(described)
        if path != packaged_file():
            _check_weights(arrays, variable_shapes(config))
    except UnknownMethod as error:
        raise UserError(f"{path}: {error}") from None
    except UNREADABLE as error:
        raise UserError(f"{path}: not a file of weights of this version ({error}); {ADVICE}") from None
    return Trained(config=config, variables=_as_variables(arrays), steps=steps)


def _as_variables(arrays: dict[str, np.ndarray]) -> dict:
    """The tree of named arrays, in float32."""
    tree = unflatten_dict({name: x.astype(np.float32) for name, x in arrays.items()}, sep="/")
    return jax.device_put(tree)  # jnp.asarray would compile


def _check_weights(arrays: dict[str, np.ndarray], shapes: dict[str, jax.ShapeDtypeStruct]) -> None:
    """ValueError for the first array that is not as a network of these shapes needs it."""
    if unknown := sorted(arrays.keys() - shapes):
        raise UserError(f"the network has no {unknown[0]}")
    for name, wanted in shapes.items():
        found = arrays.get(name, np.zeros(0))
        if found.shape != wanted.shape or found.dtype != np.float16 or not np.isfinite(found).all():
            raise UserError(
                f"{name} should hold {wanted.shape} finite float16 numbers, not {found.shape} of {found.dtype}"
            )


@cache
def variable_shapes(config: TrainConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Shape of every weight of the config's network, by name."""
    init = partial(method_of(config.model).init, config=config.model)
    return flatten_dict(jax.eval_shape(init, jax.random.key(0)), sep="/")
