"""An evaluation as files: metrics.json for programs, report.html for people.

The report is one file that holds everything, to open from disk, to mail, to keep: key numbers and summary, which
objects are scored, their pictures, quality beside the trivial renderers, settings.  Images are PNGs inside the page
(report.html is its template); nothing is loaded from elsewhere, and no script runs.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spnr_jax.formats.images import depth_image, png_url, template, write_whole
from spnr_jax.methods import METHODS, to_dict
from spnr_jax.scoring.evaluation import TRIVIAL, Evaluation, ObjectResult, Pictures, median_view
from spnr_jax.scoring.picture_scores import NO_LPIPS

OTHERS = {  # methods that are not trained -> name in tables and pictures
    "ours": "Ours",
    "nearest": "Nearest-point shading",
    "splat": "Base-colour splat",
    "white": "White image",
}
HIGHER, LOWER = 1, -1  # which values are better
QUALITY = {  # metric -> head of its column, decimals, which values are better
    "psnr": ("PSNR, dB", 2, HIGHER),
    "ssim": ("SSIM", 3, HIGHER),
    "cpsnr": ("cPSNR, dB", 2, HIGHER),
    "flip": ("FLIP", 3, LOWER),
    "lpips": ("LPIPS", 3, LOWER),
    "iou": ("Opacity IoU", 3, HIGHER),
}
ARROWS = {HIGHER: "\N{UPWARDS ARROW}", LOWER: "\N{DOWNWARDS ARROW}"}
MISSING = {"lpips": NO_LPIPS, "iou": "n/a (no opacity)"}  # metric -> text for a missing number


class Cell(NamedTuple):
    """A text, smaller texts after it, and whether it is highlighted."""

    text: str
    small: tuple[str, ...] = ()
    best: bool = False


class Table(NamedTuple):
    """Heads (with units), rows of a name and cells, and an explanatory note."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    note: str = ""


def text(value: object) -> Cell:
    """A cell without a measurement."""
    return Cell(str(value))


def number(
    value: Any,
    decimals: int,
    interval: Sequence[Any] | None = None,
    *,
    sign: str = "",
    missing: str = "n/a",
    best: bool = False,
    more: tuple[str, ...] = (),
) -> Cell:
    """A number and its interval; `sign` is "+" for differences, `more` follows the interval."""
    if value is None or not math.isfinite(value):
        return Cell(missing)
    form = f"{sign},.{decimals}f"
    ends = [f"[{', '.join(f'{end:{form}}' for end in interval)}]"] if interval else []
    return Cell(f"{value:{form}}", (*ends, *more), best)


def head(metric: str) -> str:
    """Head of a metric's column."""
    name, _, better = QUALITY[metric]
    return f"{name}\N{NO-BREAK SPACE}{ARROWS[better]}"


def quality(methods: Mapping[str, Mapping], metrics: Iterable[str]) -> dict[str, tuple[Cell, ...]]:
    """The cells of metrics by method, of rows of `summarise`: means with intervals, the best of a column marked."""
    columns = []
    for metric in metrics:
        _, decimals, better = QUALITY[metric]
        values = [row.get(metric) for row in methods.values()]
        known = [value for value in values if value is not None and math.isfinite(value)]
        best = max(known, key=lambda value: better * value) if known else None
        ends = [row.get(f"{metric}_interval") for row in methods.values()]
        missing = MISSING.get(metric, "n/a")
        pairs = zip(values, ends, strict=True)
        columns.append([number(x, decimals, e, missing=missing, best=x == best) for x, e in pairs])
    return dict(zip(methods, zip(*columns, strict=True), strict=True))


def difference(found: Mapping | None, metric: str) -> Cell:
    """The cell of a paired difference (`picture_scores.differences`), with its interval and p-value."""
    if found is None:
        return text(MISSING.get(metric, "n/a"))
    p_value = found["p_value"]
    test = () if p_value is None else ("p < 0.001",) if p_value < 0.001 else (f"p = {p_value:.3f}",)
    return number(found["mean"], QUALITY[metric][1], found["interval"], sign="+", more=test)


def label(method: str) -> str:
    """Name of a method in tables and pictures."""
    return OTHERS.get(method) or (method in METHODS and METHODS[method].label) or method


COUNTS = {"objects": "Objects", "views": "Views", "cpsnr_views": "cPSNR views"}
GALLERY_NOTE = (
    "The number below a picture is its PSNR in dB. Depth: bright is near, dark is far, spanning each picture's own "
    "range. Opacity: white is solid. Both are those of the first network."
)
QUALITY_NOTE = (
    "Means over images; cPSNR is the PSNR over the pixels of visible input points. The settings below say how each "
    "metric is measured. Arrows show what is better, the best value of a column is bold. Small: 95 % bootstrap "
    "interval over objects."
)
DIFFERENCES_NOTE = (
    "The first network minus each other method, image by image, so what makes an object hard for both cancels. Small: "
    "95 % bootstrap interval over objects, and the p-value of a sign-flip test over objects."
)


def write_results(out: Path, evaluation: Evaluation, dataset_settings: dict, seconds: dict[str, float]) -> None:
    """Writes metrics.json and report.html into a folder."""
    metrics = evaluation.summary | {"seconds": seconds}
    write_whole(out / "metrics.json", (json.dumps(metrics, indent=2, allow_nan=False) + "\n").encode())
    settings = {"training": to_dict(evaluation.config), "data": dataset_settings, **metrics["settings"]}
    write_report(out / "report.html", settings, metrics, evaluation.gallery)


def write_report(path: Path, settings: Mapping, metrics: Mapping, gallery: Sequence[ObjectResult]) -> None:
    """Write the page in one piece: of the content of metrics.json, and any nested mapping of settings.

    The first of the methods is the network that "NAME_minus" subtracts from.
    """
    methods = metrics["methods"]
    first = next(iter(methods))
    minus = metrics.get(f"{first}_minus")
    tables = [_quality_table(methods)]
    tables += [_difference_table(first, minus)] if minus else []
    shown = _shown(gallery[0]) if gallery else {}
    page = template(Path(__file__).with_name("report.html")).render(
        title=f"Sparse-point neural rendering: {describe_split(metrics)}",
        summary=_summary(metrics),
        gallery_heading=describe_split(metrics),
        gallery_note=GALLERY_NOTE,
        heads=["Reference", *(label(method) for method in shown), "Depth", "Opacity"],
        gallery=[(result.name, _pictures(result)) for result in gallery],
        tables=tables,
        facts=_run_facts(metrics) | flatten(settings),
    )
    write_whole(path, f"{page}\n".encode())


def describe_split(metrics: Mapping) -> str:
    """The scored objects, in words."""
    return f"objects of the {metrics['settings']['split']} split"


def _summary(metrics: Mapping) -> str:
    """Summary of the first network, and its lead in dB over the trivial renderers."""
    methods, settings = metrics["methods"], metrics["settings"]
    network, row = next(iter(methods.items()))
    best = max((name for name in TRIVIAL if name in methods), key=lambda name: methods[name]["psnr"])
    above = [(other, metrics[f"{network}_minus"][other]["psnr"]) for other in dict.fromkeys(("white", best))]
    texts = [
        " ".join([f"{found['mean']:+.2f} dB", *number(found["mean"], 2, found["interval"], sign="+").small])
        + (" against the white image" if other == "white" else f" against the best trivial renderer ({other})")
        for other, found in above
    ]
    return (
        f"{label(network)}: preset {metrics['preset']}, {metrics['steps']} steps. "
        f"{settings['points']} points per object. "
        f"{row['psnr']:.2f} dB PSNR on {row['views']} views of {row['objects']} {describe_split(metrics)}: "
        f"{', '.join(texts)}."
    )


def text_table(methods: Mapping[str, Mapping]) -> list[str]:
    """Lines of the table of methods for a terminal."""
    lines = []
    for method, row in methods.items():
        texts = [
            f"{column.partition(',')[0]} {number(row[name], decimals, missing=MISSING.get(name, 'n/a')).text}"
            for name, (column, decimals, _) in QUALITY.items()
        ]
        lines.append(f"{label(method):22s} " + "   ".join(texts))
    return lines


def flatten(settings: Mapping, prefix: str = "") -> dict[str, object]:
    """The entries of a nested mapping under dotted names."""
    flat: dict[str, object] = {}
    for name, value in settings.items():
        inner = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return flat


def _shown(result: ObjectResult) -> dict[str, Pictures]:
    """Pictures of the gallery: all methods except the white image, networks first."""
    return {method: pictures for method, pictures in result.pictures.items() if method != "white"}


def _pictures(result: ObjectResult) -> list[tuple[str, str]]:
    """Address and caption of each picture of an object: the view whose PSNR is the median, of the first network."""
    first = next(iter(result.pictures))
    view, own = median_view(result.scores[first]["psnr"]), result.pictures[first]
    assert own.depth is not None
    pictures = [(result.reference[view], "")]
    for method, shown in _shown(result).items():
        pictures.append((shown.image[view], f"{result.scores[method]['psnr'][view]:.1f}"))
    pictures += [(depth_image(own.depth[view], own.acc[view]), ""), (own.acc[view], "")]
    return [(png_url(np.asarray(image)), caption) for image, caption in pictures]


def _quality_table(methods: Mapping[str, Mapping]) -> Table:
    """Methods against metrics and counts; columns that no method has are left out."""
    shown, counts = ([name for name in of if any(name in s for s in methods.values())] for of in (QUALITY, COUNTS))
    cells = quality(methods, shown)
    rows = tuple(
        (label(method), (*cells[method], *(text(scores.get(name, "")) for name in counts)))
        for method, scores in methods.items()
    )
    heads = (*map(head, shown), *(COUNTS[name] for name in counts))
    return Table(title="Quality", note=QUALITY_NOTE, heads=heads, rows=rows)


def _difference_table(first: str, minus: Mapping[str, Mapping]) -> Table:
    """Other methods against the difference in each metric."""
    names = [name for name in QUALITY if any(name in row for row in minus.values())]
    rows = tuple(
        (f"{label(first)} minus {label(method)}", tuple(difference(row.get(m), m) for m in names))
        for method, row in minus.items()
    )
    return Table(title="Differences", note=DIFFERENCES_NOTE, heads=tuple(map(head, names)), rows=rows)


def _run_facts(metrics: Mapping) -> dict[str, object]:
    """Facts about the run, such as durations; the rest of metrics.json has its own tables."""
    tables = ("methods", f"{next(iter(metrics['methods']))}_minus", "settings")
    return flatten({name: value for name, value in metrics.items() if name not in tables})
