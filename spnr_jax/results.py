"""An evaluation as files: metrics.json for programs, report.html for people."""

import json
from pathlib import Path

import numpy as np

from spnr_jax.config import to_dict
from spnr_jax.evaluation import Evaluation, ObjectResult
from spnr_jax.images import write_whole
from spnr_jax.report import GalleryRow, write_report


def write_results(
    out: Path,
    evaluation: Evaluation,
    dataset_settings: dict,
    curve: list[dict],
    seconds: dict[str, float],
    title: str = "Sparse-point neural rendering: objects that the network never saw",
) -> None:
    """Writes metrics.json and report.html into a folder."""
    metrics = {**evaluation.summary, "seconds": seconds, "per_category": evaluation.per_category}
    write_whole(out / "metrics.json", (json.dumps(metrics, indent=2, allow_nan=False) + "\n").encode())
    ours, floors = metrics["methods"]["ours"], {k: v for k, v in metrics["methods"].items() if k != "ours"}
    best = max(floors, key=lambda name: floors[name]["psnr"])
    summary = (
        f"Preset {metrics['preset']}, {metrics['steps']} steps, {evaluation.config.test_points} points per object. "
        f"{ours['psnr']:.2f} dB PSNR on {ours['views']} views of {ours['objects']} unseen objects: "
        f"{ours['psnr'] - floors['white']['psnr']:+.2f} dB against the white image, "
        f"{ours['psnr'] - floors[best]['psnr']:+.2f} dB against the best trivial renderer ({best})."
    )
    write_report(
        out / "report.html",
        title=title,
        summary=summary,
        settings={"training": to_dict(evaluation.config), "data": dataset_settings, **metrics["settings"]},
        metrics=metrics,
        gallery=[gallery_row(result) for result in evaluation.gallery],
        curve=curve,
        per_category=evaluation.per_category,
    )


def gallery_row(result: ObjectResult) -> GalleryRow:
    """The view of an object whose PSNR is the median: neither flattered nor slandered."""
    psnr = result.scores["ours"].psnr
    view = int(np.argsort(psnr)[len(psnr) // 2])
    return GalleryRow(
        name=result.name,
        reference=result.reference[view],
        ours=result.images["ours"][view],
        splat=result.images["splat"][view],
        nearest=result.images["nearest"][view],
        depth=result.depth[view],
        acc=result.acc[view],
    )
