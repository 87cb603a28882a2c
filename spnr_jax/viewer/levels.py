"""What a quality costs and loses: the figures of the README's table, which a test compares with it.

They are of the preset `tiny` on 12 unseen procedural objects at 64 x 64, 1024 points, two cores of an Intel Xeon,
2026-11-22 (`python -m experiments.studies.speed_accuracy`): how the levels compare, not what this machine needs, which
the viewer measures.
"""

from dataclasses import dataclass

from spnr_jax.model import Quality

SOURCE = "README, Speed and quality: `tiny`, 12 unseen objects, 64 x 64"


@dataclass(frozen=True, kw_only=True)
class Level:
    """A row of the table."""

    psnr: float
    flip: float
    milliseconds: float


LEVELS: dict[Quality, Level] = {
    "draft": Level(psnr=21.59, flip=0.137, milliseconds=3.1),
    "balanced": Level(psnr=21.64, flip=0.137, milliseconds=3.9),
    "best": Level(psnr=21.65, flip=0.137, milliseconds=4.7),
    "trained": Level(psnr=21.51, flip=0.140, milliseconds=6.5),
}


def expected_loss(quality: Quality) -> tuple[float, float]:
    """(dB of PSNR lost, FLIP gained) against `best`."""
    level, best = LEVELS[quality], LEVELS["best"]
    return best.psnr - level.psnr, level.flip - best.flip


def table(measured: dict[tuple[Quality, int], float]) -> str:
    """Markdown: each quality's expected loss, and the newest milliseconds measured here with the pixels drawn."""
    rows = ["| quality | ms here | PSNR | FLIP |", "|---|---:|---:|---:|"]
    for quality in LEVELS:
        times = [f"{ms:.0f} ({size}²)" for (name, size), ms in sorted(measured.items()) if name == quality]
        psnr, flip = expected_loss(quality)
        rows.append(f"| {quality} | {', '.join(times) or '-'} | {0 - psnr:+.2f} dB | {flip:+.3f} |")
    return "\n".join([*rows, "", f"Loss against `best`. {SOURCE}"])
