"""What experiments.point_count found, as tables and as curves."""

import io

from spnr_jax.scoring.report import QUALITY

METRICS = ("psnr", "flip", "iou")
COLORS = ("#2457d6", "#d9480f", "#2f9e44", "#9c36b5", "#0b7285", "#e8a700", "#868e96", "#495057", "#adb5bd")


def table(results: dict) -> str:
    """Markdown: a table for each metric, methods x counts."""
    parts = []
    for metric in METRICS:
        head, decimals, _ = QUALITY[metric]
        lines = [f"| {head} | {' | '.join(f'{count:,}' for count in results['counts'])} |"]
        lines.append("|---|" + "---:|" * len(results["counts"]))
        for label, curves in results["curves"].items():
            cells = [cell(point, decimals) for point in curves.get(metric, ())]
            lines.append(f"| {label} | {' | '.join(cells or ['n/a'] * len(results['counts']))} |")
        parts.append("\n".join([*lines, ""]))
    parts.append(class_table(results))
    low, high = results["trained on"]
    note = (
        f"{len(results['objects'])} unseen objects; means over images with 95 % bootstrap intervals over objects. "
        f"The first network trained on {low} to {high} points. {results['hardware']}."
    )
    return "\n".join([*parts, note, ""])


def class_table(results: dict) -> str:
    """Markdown: PSNR of the methods on each class of objects at one count, and how often each is the best."""
    classes = results["classes"]
    heads = [f"{name} ({found['objects']})" for name, found in classes.items()]
    lines = [f"| PSNR, dB, {results['class points']:,} points | {' | '.join(heads)} | best on objects |"]
    lines.append("|---|" + "---:|" * (len(heads) + 1))
    for label in results["curves"]:
        cells = [f"{found['psnr'][label]:.2f}" for found in classes.values()]
        best = sum(found["best on"][label] for found in classes.values())
        lines.append(f"| {label} | {' | '.join(cells)} | {best} |")
    return "\n".join([*lines, ""])


def cell(point: dict, decimals: int) -> str:
    """A mean and its interval."""
    ends = point["interval"]
    small = "" if ends is None else f" [{ends[0]:.{decimals}f}, {ends[1]:.{decimals}f}]"
    return f"{point['mean']:.{decimals}f}{small}"


def plot(results: dict) -> bytes:
    """PNG of each metric over the number of points; bands are the intervals, grey is what the network trained on."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 4.2), layout="constrained")
    panels = figure.subplots(1, len(METRICS))
    for axes, metric in zip(panels, METRICS, strict=True):
        axes.axvspan(*results["trained on"], color="#f1f3f5", zorder=0)
        for (label, curves), color in zip(results["curves"].items(), COLORS * 3, strict=False):
            if metric not in curves:
                continue
            rows = curves[metric]
            axes.plot([r["points"] for r in rows], [r["mean"] for r in rows], "o-", ms=4, color=color, label=label)
            if rows[0]["interval"] is not None:
                low, high = zip(*(r["interval"] for r in rows), strict=True)
                axes.fill_between([r["points"] for r in rows], low, high, color=color, alpha=0.08, lw=0)
        axes.set_xscale("log")
        axes.set_xticks(results["counts"], [f"{count:,}" for count in results["counts"]], fontsize=8)
        axes.minorticks_off()
        axes.set_xlabel("points at test")
        axes.set_ylabel(QUALITY[metric][0] + (", lower is better" if metric == "flip" else ""))
        axes.grid(alpha=0.2)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()
