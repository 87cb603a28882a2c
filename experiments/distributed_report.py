"""What experiments.distributed found, as a table and as curves."""

import io

import numpy as np


def table(results: dict) -> str:
    """Markdown: how far every layout lies from one device, gradients, memory of a device, and what each renders."""
    lines = [
        f"| {results['steps']} steps, {results['batch_objects']} objects each | loss | any metric | running statistics "
        "| averaged parameters | ms a step |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    cut = {"128^3 voxels, 1 object: 4 devices, the volume cut in 4": results["cut"]}
    for name, row in (results["layouts"] | cut).items():
        cells = (f"{row[key]:.1e}" for key in ("loss", "metrics", "statistics", "parameters"))
        lines.append(f"| {name} | {' | '.join(cells)} | {row['ms']:.0f} |")
    devices = list(next(iter(results["memory"].values())))
    lines += ["", f"| MiB of each device | {' | '.join(devices)} |", f"|---|{'---:|' * len(devices)}"]
    for resolution, row in results["memory"].items():
        first = row[devices[0]]
        cells = (f"{value:,.0f} ({first / value:.1f})" if value != first else f"{value:,.0f}" for value in row.values())
        lines.append(f"| {resolution}^3 voxels | {' | '.join(cells)} |")
    lines += ["", "| gradients of the first step, the volume cut in 4 | loss | worst array | median array |"]
    lines.append("|---|---:|---:|---:|")
    lines += [
        f"| {precision} | {row['loss']:.1e} | {row['gradients']:.1e} ({row['array']}) | {row['median']:.1e} |"
        for precision, row in results["gradients"].items()
    ]
    lines += ["", "| 8 views rendered | devices | seconds of all | of each | blocks of each | pixel off by |"]
    lines.append("|---|---:|---:|---:|---:|---:|")
    for network, rows in results["rendering"].items():
        for count, row in rows.items():
            share, blocks = row["seconds"] / int(count) / rows["1"]["seconds"], row.get("blocks", ["-"])
            numbers = (count, f"{row['seconds']:.2f}", f"{share:.0%}", str(max(blocks)), f"{row['apart']:.1e}")
            lines.append(f"| {network} | {' | '.join(numbers)} |")
    note = (
        f"Seed {results['seed']}; {results['hardware']}. Differences are relative, the "
        "largest of all steps; statistics and parameters by norms, after the last step. All devices share the same "
        "cores: the pace says what the division costs, not what it gains. Memory: arguments, results and temporary "
        "arrays of a step of the preset abo with one object, as XLA lays them out; in brackets how many times less "
        "than on one device. Gradients: the largest difference in an array over its largest entry. Seconds are those "
        "of the processor; of each: all divided by the devices, as a share of one alone."
    )
    return "\n".join([*lines, "", note, ""])


def plot(results: dict) -> bytes:
    """PNG: the loss on one device, and the differences of the others; memory of a device."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    rows = {name: row["loss"] for name, row in results["layouts"].items() if name != "1 device"}
    places = np.arange(len(rows))
    left.barh(places, list(rows.values()), color="#2457d6", height=0.6)
    left.axvline(1e-5, color="#d9480f", linewidth=1)
    left.set(xscale="log", xlabel="largest relative difference of a loss from one device", yticks=places)
    left.set_yticklabels(rows, fontsize=8)
    left.invert_yaxis()
    left.set_xlim(1e-8, 1e-4)
    left.text(1.1e-5, len(rows) - 0.6, "1e-5", color="#d9480f", fontsize=8, va="center")
    for (resolution, row), color in zip(results["memory"].items(), ("#2457d6", "#d9480f"), strict=False):
        counts, values = np.array([int(x) for x in row]), np.array(list(row.values())) / 1024
        right.plot(counts, values, "o-", color=color, label=f"{resolution}³ voxels")
        right.plot(counts, values[0] / counts, ":", color=color, linewidth=1)
    right.set(xscale="log", yscale="log", xlabel="devices that share the volume", ylabel="GiB of each device")
    right.set_xticks([1, 2, 4, 8], ["1", "2", "4", "8"])
    right.minorticks_off()
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    stream = io.BytesIO()
    figure.savefig(stream, dpi=130)
    plt.close(figure)
    return stream.getvalue()
