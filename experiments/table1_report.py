"""The results of Table 1 as tables, and these as Markdown, LaTeX and CSV.

A table is heads and rows of cells; a cell is a text, smaller ones behind it (an interval), and whether it is the best
of its column.  Every form is written from the same cells.  Numbers of the CSV are not rounded.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from experiments.table1_training import QUICK_STEPS
from spnr_jax.scoring.report import ARROWS, QUALITY, duration
from spnr_jax.scoring.summary import NO_WEIGHTS

LABELS = {
    "ours": "Ours",
    "plus": "Ours, plus",
    "npbg": "NPBG",
    "point_nerf": "Point-NeRF",
    "points2nerf": "Points2NeRF",
    "poisson": "Poisson",
    "poisson_trimmed": "Poisson, trimmed 0.3",
    "nearest": "Nearest-point shading",
    "splat": "Base-colour splat",
    "white": "White image",
}
METRICS = ("psnr", "ssim", "lpips", "flip", "cpsnr", "iou")
COSTS = {"parameters": "Parameters", "steps": "Steps", "training_seconds": "Training", "ms_per_view": "ms per view"}
MISSING = {"lpips": NO_WEIGHTS, "iou": "n/a (no opacity)"}
BUDGETS = {
    "quick": f"the tiny presets for {QUICK_STEPS} steps each, which shows that everything runs and nothing else",
    "tiny": "the tiny presets, 64 px",
    "paper": "the paper presets",
}
TEX = {"\\": r"\textbackslash{}", "%": r"\%", "&": r"\&", "_": r"\_", "#": r"\#", "$": r"\$", "<": r"$<$"}
TEX |= {"\N{UPWARDS ARROW}": r"$\uparrow$", "\N{DOWNWARDS ARROW}": r"$\downarrow$", "\N{NO-BREAK SPACE}": "~"}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A text, smaller ones behind it, and whether it is to stand out."""

    text: str
    small: tuple[str, ...] = ()
    best: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """Heads, rows of a name and cells, and a line that says how to read them."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    note: str = ""


def tables(results: Mapping) -> list[Table]:
    """The table of methods, the differences, and a table of each class of objects."""
    made = [methods_table(results)]
    if results["ours_minus"]:
        made.append(differences_table(results["ours_minus"]))
    for name, methods in results["per_category"].items():
        count = next(iter(methods.values()))["objects"]
        title = f"{name}, {count} object{'s' * (count != 1)}"
        made.append(Table(title=title, heads=_metric_heads(), rows=_rows(methods, _quality(methods))))
    return made


def methods_table(results: Mapping) -> Table:
    """Quality and cost of every method; rows that could not be made say why."""
    methods, missing = results["methods"], results["missing"]
    cost = {name: tuple(_cost(results["costs"][name], column) for column in COSTS) for name in methods}
    quality = _quality(methods)
    rows = dict(_rows(methods, {name: quality[name] + cost[name] for name in methods}))
    rows |= {LABELS[name]: (Cell(text=reason),) for name, reason in missing.items()}
    counts = next(iter(methods.values()))
    return Table(
        title=f"Methods, {counts['objects']} unseen objects, {counts['views']} views",
        heads=(*_metric_heads(), *COSTS.values()),
        rows=tuple((label, rows[label]) for label in LABELS.values() if label in rows),
        note="Means over images with 95 % bootstrap intervals over objects; the best of a column stands out.",
    )


def differences_table(ours_minus: Mapping) -> Table:
    """Ours minus each other method, image by image."""
    rows = tuple(
        (f"Ours minus {LABELS[name]}", tuple(_difference(row.get(metric), metric) for metric in METRICS))
        for name, row in ours_minus.items()
    )
    note = "Image by image, with 95 % bootstrap intervals and the p-value of a sign-flip test, both over objects."
    return Table(title="Paired differences", heads=_metric_heads(), rows=rows, note=note)


def _metric_heads() -> tuple[str, ...]:
    return tuple(f"{QUALITY[m][0]}\N{NO-BREAK SPACE}{ARROWS[QUALITY[m][2]]}" for m in METRICS)


def _rows(methods: Mapping, cells: Mapping[str, tuple[Cell, ...]]) -> tuple[tuple[str, tuple[Cell, ...]], ...]:
    return tuple((LABELS[name], cells[name]) for name in methods)


def _quality(methods: Mapping[str, Mapping]) -> dict[str, tuple[Cell, ...]]:
    """The cells of all metrics by method."""
    columns = []
    for metric in METRICS:
        _, decimals, better = QUALITY[metric]
        values = [row[metric] for row in methods.values() if row[metric] is not None]
        best = max(values, key=lambda value: better * value) if values else None
        columns.append(
            [
                Cell(text=MISSING.get(metric, "n/a"))
                if row[metric] is None
                else Cell(
                    text=f"{row[metric]:.{decimals}f}",
                    small=_interval(row[f"{metric}_interval"], decimals),
                    best=row[metric] == best,
                )
                for row in methods.values()
            ]
        )
    return dict(zip(methods, zip(*columns, strict=True), strict=True))


def _interval(ends: Sequence[float] | None, decimals: int, sign: str = "") -> tuple[str, ...]:
    return () if ends is None else (f"[{ends[0]:{sign}.{decimals}f}, {ends[1]:{sign}.{decimals}f}]",)


def _difference(found: Mapping | None, metric: str) -> Cell:
    if found is None:
        return Cell(text=MISSING.get(metric, "n/a"))
    decimals, p_value = QUALITY[metric][1], found["p_value"]
    test = () if p_value is None else ("p < 0.001",) if p_value < 0.001 else (f"p = {p_value:.3f}",)
    small = _interval(found["interval"], decimals, sign="+") + test
    return Cell(text=f"{found['mean']:+.{decimals}f}", small=small)


def _cost(cost: Mapping, column: str) -> Cell:
    value = cost.get(column)
    if value is None:
        return Cell(text="-")
    if column == "training_seconds":
        return Cell(text=duration(value))
    return Cell(text=f"{value:.1f}" if column == "ms_per_view" else f"{value:,}")


def notes(results: Mapping) -> list[str]:
    """What a reader has to know of the numbers: budget, data, machine, seed, how they were measured."""
    counts, costs = next(iter(results["methods"].values())), results["costs"]
    presets = ", ".join(f"{LABELS[name]} {cost['preset']}" for name, cost in costs.items() if "preset" in cost)
    minutes = results["minutes"]
    rule = (
        "every network trains the steps of its preset"
        if minutes is None
        else f"every network trains as many steps as fit into {minutes:g} minutes on this machine, its warm-up and "
        "decay over exactly these; measured beforehand, compilation, checkpoints and previews not counted"
    )
    budget = f"Budget {results['budget']}: {BUDGETS[results['budget']]}"
    factors = ", ".join(f"{LABELS[name]} {value:g}" for name, value in results["radius_factors"].items())
    objects = results["data"]
    lines = [
        budget + ("." if results["budget"] == "quick" else f"; {rule}.") + (f" Presets: {presets}." if presets else ""),
        f"All methods: the same {objects['train objects']} training objects, {counts['objects']} test objects of "
        f"{objects['test objects']}, cameras, and first {results['points']} points; {results['resolution']} px.",
        f"Hardware: {results['hardware']}; Poisson surfaces are made and rendered on its CPU. Seed {results['seed']}.",
        "Training is the time of the steps, without compilation. ms per view: median over the objects but the first; "
        "what is done once per object is shared by its views.",
        *(f"{name}: {text}." for name, text in results["metrics"].items()),
    ]
    return lines + ([f"Radius of a point, in point spacings, best on training objects: {factors}."] if factors else [])


def markdown(made: Sequence[Table], lines: Sequence[str]) -> str:
    """The tables, and the notes as a list."""
    parts = []
    for table in made:
        bar = ["|" + "---|" + "---:|" * len(table.heads)]
        rows = [f"| {' | '.join(map(_markdown_text, ['', *table.heads]))} |", *bar]
        for name, cells in table.rows:
            empty = [""] * (len(table.heads) - len(cells))
            rows.append(f"| {' | '.join([name, *map(_markdown_cell, cells), *empty])} |")
        parts.append("\n".join([f"### {table.title}", "", *([table.note, ""] if table.note else []), *rows, ""]))
    return "\n".join([*parts, *(f"- {line}" for line in lines)]).rstrip() + "\n"


def _markdown_text(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ")


def _markdown_cell(cell: Cell) -> str:
    text = f"**{cell.text}**" if cell.best else cell.text
    return " ".join([text, *cell.small])


def latex(made: Sequence[Table], lines: Sequence[str]) -> str:
    """The tables for LaTeX with the package booktabs; the notes are comments at the top."""
    parts = [*(f"% {line}" for line in lines), "% needs \\usepackage{booktabs}"]
    for table in made:
        caption = _tex(f"{table.title}. {table.note}".strip())
        parts += [r"\begin{table}", r"\centering\footnotesize", rf"\caption{{{caption}}}"]
        parts += [rf"\begin{{tabular}}{{l{'r' * len(table.heads)}}}", r"\toprule"]
        parts += [" & ".join(["", *map(_tex, table.heads)]) + r" \\", r"\midrule"]
        for name, cells in table.rows:
            texts = [_tex_cell(cell) for cell in cells]
            if len(cells) < len(table.heads):
                texts = [rf"\multicolumn{{{len(table.heads)}}}{{l}}{{{texts[0]}}}"]
            parts.append(" & ".join([_tex(name), *texts]) + r" \\")
        parts += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    return "\n".join(parts) + "\n"


def _tex(text: str) -> str:
    return "".join(TEX.get(letter, letter) for letter in text)


def _tex_cell(cell: Cell) -> str:
    text = rf"\textbf{{{_tex(cell.text)}}}" if cell.best else _tex(cell.text)
    return text + (rf" {{\tiny {_tex(' '.join(cell.small))}}}" if cell.small else "")


def csv_text(results: Mapping) -> str:
    """One line for each class of objects (all first) and method: means, interval ends, differences, costs."""
    stream = io.StringIO()
    columns = [f"{metric}{end}" for metric in METRICS for end in ("", "_low", "_high")]
    changes = [f"ours_minus_{metric}{end}" for metric in METRICS for end in ("", "_low", "_high", "_p")]
    counts = ("objects", "views", "cpsnr_views")
    writer = csv.DictWriter(
        stream, ["objects_of", "method", *counts, *columns, *changes, "preset", *COSTS], lineterminator="\n"
    )
    writer.writeheader()
    for scope, methods in {"all": results["methods"], **results["per_category"]}.items():
        for method, row in methods.items():
            line = {"objects_of": scope, "method": method} | {name: row[name] for name in counts}
            for metric in METRICS:
                line |= _ends(metric, row[metric], row[f"{metric}_interval"])
            if scope == "all":
                for metric, found in results["ours_minus"].get(method, {}).items():
                    if found is not None:
                        line |= _ends(f"ours_minus_{metric}", found["mean"], found["interval"])
                        line[f"ours_minus_{metric}_p"] = found["p_value"]
                line |= results["costs"][method]
            writer.writerow(line)
    return stream.getvalue()


def _ends(name: str, mean: float | None, ends: Sequence[float] | None) -> dict[str, float | None]:
    low, high = ends or (None, None)
    return {name: mean, f"{name}_low": low, f"{name}_high": high}
