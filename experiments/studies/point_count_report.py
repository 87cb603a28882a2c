"""What experiments.studies.point_count found, as tables and as curves."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.comparison import figures
from spnr_jax.scoring.score_tables import QUALITY, Table, number, text

METRICS = ("psnr", "flip", "iou")


def tables_of(found: Mapping) -> list[Table]:
    """A table for each metric, methods x counts, and one of the classes of objects at one count."""
    counts, made = found["counts"], []
    for metric in METRICS:
        head, decimals, _ = QUALITY[metric]
        rows = tuple(
            (label, tuple(number(at["mean"], decimals, at["interval"]) for at in curves.get(metric, ())))
            for label, curves in found["curves"].items()
        )
        rows = tuple((label, cells or (text("n/a"),)) for label, cells in rows)
        made.append(Table(title=f"{head}, by number of points", heads=tuple(f"{n:,}" for n in counts), rows=rows))
    classes = found["classes"]
    heads = (*(f"{name} ({one['objects']})" for name, one in classes.items()), "best on objects")
    rows = tuple(
        (
            label,
            (
                *(number(one["psnr"][label], 2) for one in classes.values()),
                number(sum(one["best on"][label] for one in classes.values()), 0),
            ),
        )
        for label in found["curves"]
    )
    return [*made, Table(title=f"PSNR, dB, {found['class points']:,} points", heads=heads, rows=rows)]


def notes(found: Mapping) -> list[str]:
    """What a reader has to know of the numbers."""
    low, high = found["trained on"]
    how = "means over images with 95 % bootstrap intervals over objects"
    return [
        f"{len(found['objects'])} unseen objects; {how}. {found['hardware']}.",
        f"The first network trained on {low} to {high} points.",
    ]


@figures.drawing
def plot(found: Mapping) -> Figure:
    """Each metric over the number of points; bands are the intervals, grey is what the network trained on."""
    figure = Figure(figsize=(14, 4.2))
    panels = figure.subplots(1, len(METRICS))
    for axes, metric in zip(panels, METRICS, strict=True):
        axes.axvspan(*found["trained on"], color="#f1f3f5", zorder=0)
        for (label, curves), color in zip(found["curves"].items(), figures.COLORS * 3, strict=False):
            if metric in curves:
                draw_curve(axes, curves[metric], label, color)
        axes.set_xscale("log")
        axes.set_xticks(found["counts"], [f"{count:,}" for count in found["counts"]])
        axes.minorticks_off()
        axes.set_xlabel("points at test")
        axes.set_ylabel(QUALITY[metric][0] + (", lower is better" if metric == "flip" else ""))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draw_curve(axes: Axes, rows: Sequence[Mapping], label: str, color: str) -> None:
    """One method's means and intervals."""
    counts = [row["points"] for row in rows]
    axes.plot(counts, [row["mean"] for row in rows], "o-", ms=4, color=color, label=label)
    if rows[0]["interval"] is not None:
        low, high = zip(*(row["interval"] for row in rows), strict=True)
        axes.fill_between(counts, low, high, color=color, alpha=0.08, lw=0)
