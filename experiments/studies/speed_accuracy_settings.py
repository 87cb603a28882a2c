"""The ways in which `speed_accuracy` asks a network for a picture."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from spnr_jax.config import NetworkConfig, RayNetworkConfig, SurfelConfig
from spnr_jax.method.model import Quality

SHARES = (0.75, 0.5, 0.25)  # of the pixels along a side that are drawn; the picture is enlarged from there


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A way to ask a network for a picture; `share` of its pixels along a side are drawn."""

    group: str
    name: str
    config: NetworkConfig
    points: int
    quality: Quality = "best"
    share: float | int = 1


def settings(config: NetworkConfig, counts: Sequence[int]) -> list[Setting]:
    """Every way to ask a network, its best level first; of all but the first number of points the levels alone."""
    levels: tuple[Quality, ...] = ("best",)
    if isinstance(config, SurfelConfig):
        levels = ("best", "balanced", "draft")
    elif isinstance(config, RayNetworkConfig):
        levels = ("best", "balanced", "draft") if config.sampling.reach else ("best", "balanced", "draft", "trained")
    common: dict[str, Any] = {"config": config, "points": counts[0]}
    ways = [Setting(group="level", name=level, quality=level, **common) for level in levels]
    if config.any_size:
        enlarged: dict[str, Any] = {"group": "fewer pixels", **common}
        ways += [Setting(name=f"best, {share:g} of the size", share=share, **enlarged) for share in SHARES]
        if "draft" in levels:
            ways.append(Setting(name="draft, 0.5 of the size", quality="draft", share=0.5, **enlarged))
    if isinstance(config, RayNetworkConfig):
        ways += _of_rays(config, counts[0])
    for count in counts[1:]:
        ways += [
            Setting(group="points", name=f"{level}, {count:,} points", config=config, points=count, quality=level)
            for level in ("best", "draft")
            if level in levels
        ]
    return ways


def _of_rays(config: RayNetworkConfig, points: int) -> list[Setting]:
    """Other samples along a ray, each drawn as the network was trained but for these, and bfloat16."""
    total, reach = config.sampling.num_coarse + config.sampling.num_fine, config.sampling.reach
    halves = [max(total // k, 2) for k in (1, 2, 4)]
    if reach:  # the levels have fewer
        ways = [("near points", f"{2 * total} near points", (2 * total, 0, reach))]
    else:
        ways = [("samples", f"{n // 2} + {n // 2} in the box", (n // 2, n // 2, 0)) for n in (2 * total, *halves[1:])]
        ways += [("near points", f"{n} within {r} voxels", (n, 0, r)) for r in (1, 2) for n in halves]

    def made(group: str, name: str, **changed: Any) -> Setting:
        other = dataclasses.replace(config, **changed)
        return Setting(group=group, name=name, config=other, points=points, quality="trained")

    names = ("num_coarse", "num_fine", "reach")
    found = [
        made(group, name, sampling=dataclasses.replace(config.sampling, **dict(zip(names, values, strict=True))))
        for group, name, values in ways
    ]
    found.append(made("bfloat16", "bfloat16", precision="bfloat16"))
    return list({way.name: way for way in found}.values())  # small counts give one setting twice
