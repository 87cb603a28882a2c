"""An evaluation as files: metrics.json for programs, report.html for people."""

import json
from pathlib import Path

import numpy as np

from spnr_jax.formats.config_json import to_dict
from spnr_jax.formats.images import write_whole
from spnr_jax.scoring.evaluation import FLOORS, Evaluation, ObjectResult, median_view
from spnr_jax.scoring.report import GalleryRow, write_report
from spnr_jax.scoring.score_tables import METHODS, MISSING, QUALITY, lowered, number


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
    methods = metrics["methods"]
    best = max(FLOORS, key=lambda name: methods[name]["psnr"])
    network, *others = metrics["settings"]["networks"]
    scores = methods[network]
    compared = [(lowered(name), name) for name in others] + [("the white image", "white")]
    compared += [(f"the best trivial renderer ({best})", best)]
    summary = (
        f"{METHODS[network]}: preset {metrics['preset']}, {metrics['steps']} steps. "
        f"{evaluation.config.test_points} points per object. "
        f"{scores['psnr']:.2f} dB PSNR on {scores['views']} views of {scores['objects']} unseen objects: "
        + ", ".join(f"{_difference(metrics, name)} against {words}" for words, name in compared)
        + "."
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


def _difference(metrics: dict, other: str) -> str:
    """How many dB the first network is above another method, with its interval."""
    found = metrics[f"{next(iter(metrics['methods']))}_minus"][other]["psnr"]
    ends = found["interval"]
    return f"{found['mean']:+.2f} dB" + (f" [{ends[0]:+.2f}, {ends[1]:+.2f}]" if ends else "")


def text_table(methods: dict[str, dict]) -> list[str]:
    """Lines of the table of methods for a terminal: means, and what could not be measured."""
    lines = []
    for method, row in methods.items():
        texts = [
            f"{head.partition(',')[0]} {number(row[name], decimals, missing=MISSING.get(name, 'n/a')).text}"
            for name, (head, decimals, _) in QUALITY.items()
        ]
        lines.append(f"{METHODS[method]:22s} " + "   ".join(texts))
    return lines


def gallery_row(result: ObjectResult) -> GalleryRow:
    """The view of an object whose PSNR is the median, of the first network."""
    first = next(iter(result.pictures))
    view = median_view(result.scores[first]["psnr"])
    shown = result.pictures[first]
    assert shown.depth is not None
    return GalleryRow(
        name=result.name,
        reference=result.reference[view],
        images={m: np.asarray(p.image[view]) for m, p in result.pictures.items() if m != "white"},
        depth=np.asarray(shown.depth[view]),
        acc=np.asarray(shown.acc[view]),
    )
