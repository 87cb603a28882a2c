"""The twin's side of the benchmark: one mode of the PyTorch network of experiments/speed/twin.py.

This module must not import JAX: its memory would be counted as the twin's.
"""

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from experiments.speed import bench_scene, twin, worker

VARIANTS = {"plain": ("plain", False), "fast": ("fast", False), "compiled": ("fast", True)}  # implementation, compile
WARM_UP = 8  # torch.compile and oneDNN settle later


def main() -> None:
    """Serves the mode of the spec."""
    worker.serve(make)


def make(spec: dict) -> tuple[Callable[[], object], dict]:
    """(function to time, facts); in the mode "parity" nothing is timed and a file is written."""
    torch.set_num_threads(spec["threads"])
    torch.manual_seed(0)
    config, device = twin.PRESETS[spec["preset"]], spec.get("platform", "cpu")
    torch.set_default_device(device)
    inputs = bench_scene.arrays(spec["batch"], config.image, config.points)
    batch = twin.Batch(
        **{name.removeprefix("in/"): torch.from_numpy(array).to(device) for name, array in inputs.items()}
    )
    facts = {"software": f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}"}
    if spec["mode"] == "parity":
        found: dict[str, Any] = {**inputs, **outputs(config, batch)}
        np.savez(spec["parity"], **found)
        return lambda: None, facts
    work = function(config, batch, spec["mode"], *VARIANTS[spec["variant"]])

    def run() -> None:
        with torch.autocast(device, torch.bfloat16, enabled=bool(spec.get("bf16"))):
            work()
        if device == "cuda":
            torch.cuda.synchronize()

    for _ in range(WARM_UP):
        run()
    return run, facts


def function(
    config: twin.Config, batch: twin.Batch, mode: str, implementation: str, compiled: bool
) -> Callable[[], object]:
    """One step, one encoding of the batch, or one view of each of its volumes."""
    if mode.startswith("train"):
        step = twin.trainer(config, implementation, compiled, adversarial=mode == "train")
        return lambda: step(batch)
    generator = twin.Generator(config, implementation).eval()
    if compiled:
        twin.compiled(generator)
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


def outputs(config: twin.Config, batch: twin.Batch) -> dict[str, np.ndarray]:
    """Sizes and weights of both networks, and what the implementations "plain" and "fast" make of the batch."""
    judge = twin.Discriminator(config).eval()
    weights = twin.Generator(config).state_dict()
    found = {"meta": np.asarray(json.dumps({"config": dataclasses.asdict(config)}))}
    for prefix, state in (("gen", weights), ("disc", judge.state_dict())):
        found |= {f"param/{prefix}.{name}": tensor.numpy() for name, tensor in state.items()}
    for name in twin.IMPLS:
        generator = twin.Generator(config, name).eval()
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
