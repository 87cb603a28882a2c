"""The twin's side of the benchmark: one mode of a PyTorch network whose file the spec names.

The file has the interface of the parity twin: PRESETS, IMPLS, Batch, Trainer, compile_generator.  This module must not
import JAX: its memory would be counted as the twin's.
"""

import dataclasses
import importlib.util
import json
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from experiments import bench_scene, bench_worker

PRESET_NAMES = {"abo": "paper"}  # where the twin calls ours differently
VARIANTS = {"plain": ("plain", False), "fast": ("fast", False), "compiled": ("fast", True)}  # implementation, compile
WARM_UP = 8  # torch.compile and oneDNN settle later


def main() -> None:
    """Serves the mode of the spec."""
    bench_worker.serve(make)


def make(spec: dict) -> tuple[Callable[[], object], dict]:
    """(function to time, facts); in the mode "parity" nothing is timed and a file is written."""
    import torch

    twin = load(spec["twin"])
    torch.set_num_threads(spec["threads"])
    torch.manual_seed(0)
    config = dataclasses.replace(twin.PRESETS[PRESET_NAMES.get(spec["preset"], spec["preset"])], r1_every=0)
    inputs = bench_scene.arrays(spec["batch"], config.image, config.points)
    batch = twin.Batch(**{name.removeprefix("in/"): torch.from_numpy(array) for name, array in inputs.items()})
    facts = {"software": f"torch {torch.__version__}"}
    if spec["mode"] == "parity":
        found: dict[str, Any] = {**inputs, **outputs(twin, config, batch)}
        np.savez(spec["parity"], **found)
        return lambda: None, facts
    run = function(twin, config, batch, spec["mode"], *VARIANTS[spec["variant"]])
    for _ in range(WARM_UP):
        run()
    return run, facts


def load(path: str) -> ModuleType:
    """The twin's module from its file."""
    spec = importlib.util.spec_from_file_location("torch_twin", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["torch_twin"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def function(
    twin: ModuleType, config: Any, batch: Any, mode: str, implementation: str, compiled: bool
) -> Callable[[], object]:
    """One step, one encoding of the batch, or one view of each of its volumes."""
    import torch

    implementation = twin.IMPLS[implementation]
    if mode.startswith("train"):
        trainer = twin.Trainer(config, implementation, compile=compiled, adversarial=mode == "train")
        return lambda: trainer.step(batch)
    generator = twin.Generator(config, implementation).eval()
    if compiled:
        twin.compile_generator(generator)
    guard = torch.no_grad if compiled else torch.inference_mode
    with guard():
        volume = generator.encode_volume(batch.pos, batch.mat)

    def run() -> None:
        with guard():
            if mode == "encode":
                generator.encode_volume(batch.pos, batch.mat)
            else:
                generator.render_volume(volume, batch.c2w, batch.focal)

    return run


def outputs(twin: ModuleType, config: Any, batch: Any) -> dict[str, np.ndarray]:
    """Sizes and weights of both networks, and what the implementations "plain" and "fast" make of the batch."""
    import torch

    judge = twin.Discriminator(config).eval()
    weights = twin.Generator(config).state_dict()
    found = {"meta": np.asarray(json.dumps({"config": dataclasses.asdict(config)}))}
    for prefix, state in (("gen", weights), ("disc", judge.state_dict())):
        found |= {f"param/{prefix}.{name}": tensor.numpy() for name, tensor in state.items()}
    for name, implementation in twin.IMPLS.items():
        generator = twin.Generator(config, implementation).eval()
        generator.load_state_dict(weights)
        with torch.inference_mode():
            volume = generator.encode_volume(batch.pos, batch.mat)
            image = generator.render_volume(volume, batch.c2w, batch.focal)[0]
            logits = judge(image, batch.cond, batch.mask)
        stages = {"volume": volume, "image": image, "logits": logits}
        found |= {f"{name}/{stage}": tensor.contiguous().numpy() for stage, tensor in stages.items()}
    return found


if __name__ == "__main__":
    main()
