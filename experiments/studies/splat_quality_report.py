"""What experiments.studies.splat_quality found, as tables and as words below pictures; and the names that it goes by.

A row is what was found of one object: "METHOD, SIZE" -> decibels, "SPLATS, made" -> what splats took, and of the mesh
faces, glb_mb, watertight, mesh_seconds.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from spnr_jax.scoring.score_tables import Cell, Table, number

BY_MITSUBA, MESH = "splats, by Mitsuba", "mesh, by Mitsuba"


def after(seconds: float) -> str:
    """The name of splats that were refined for so long."""
    return f"splats, {seconds:g} s"


def methods_of(seconds: Sequence[float]) -> tuple[str, ...]:
    """The names of all that is compared."""
    return ("network", *map(after, seconds), BY_MITSUBA, MESH)


def caption(row: Mapping, method: str, size: int) -> str:
    """What stands below a picture: its decibels, and of what is a file its megabytes and seconds."""
    made = row.get(f"{method}, made")
    told = f"{made['spz_mb']:.1f} MB, {made['seconds']:.0f} s, " if made else ""
    if method == MESH:
        told = f"{row['glb_mb']:.1f} MB, {row['mesh_seconds']:.0f} s, "
    return f"{told}{row[f'{method}, {size}']['psnr']:.1f} dB"


def tables_of(rows: Mapping[str, Mapping], seconds: Sequence[float], sizes: Sequence[int], views: int) -> list[Table]:
    """The means over all objects, and at each size a row for each object."""
    return [_means(rows, seconds, sizes, views), *(_by_object(rows, seconds, size) for size in sizes)]


def _means(rows: Mapping[str, Mapping], seconds: Sequence[float], sizes: Sequence[int], views: int) -> Table:
    """A row for each method and size, means over the objects."""
    lines: list[tuple[str, tuple[Cell, ...]]] = []
    for size in sizes:
        for method in methods_of(seconds):
            found = [row[f"{method}, {size}"] for row in rows.values()]
            means = [float(np.mean([scores[name] for scores in found])) for name in ("psnr", "inside", "network")]
            of_network = number(None if method == "network" else means[2], 1)
            lines.append((f"{method}, {size} px", (number(means[0], 2), number(means[1], 2), of_network)))

    def mean(name: str, *of: str) -> float:
        return float(np.mean([(row[of[0]] if of else row)[name] for row in rows.values()]))

    made = [f"{after(each)}, made" for each in seconds]
    steps = " and ".join(f"{mean('steps', each):.0f}" for each in made)
    closed = sum(row["watertight"] for row in rows.values())
    return Table(
        title=f"Splats and meshes, {len(rows)} objects x {views} views",
        heads=("PSNR, dB", "inside, dB", "against the network, dB"),
        rows=tuple(lines),
        note=f"{mean('splats', made[-1]):,.0f} splats, {mean('spz_mb', made[-1]):.1f} MB as .spz, {steps} steps; "
        f"meshes of {mean('glb_mb'):.1f} MB, {closed} of them watertight. Means.",
    )


def _by_object(rows: Mapping[str, Mapping], seconds: Sequence[float], size: int) -> Table:
    """A row for each object: what its files hold, and the decibels of each method at a size."""
    methods = methods_of(seconds)

    def cells(row: Mapping) -> tuple[Cell, ...]:
        made = row[f"{after(seconds[-1])}, made"]
        counts = ((made["splats"], 0), (made["spz_mb"], 2), (row["faces"], 0), (row["glb_mb"], 2))
        scores = ((row[f"{method}, {size}"]["psnr"], 2) for method in methods)
        return tuple(number(*each) for each in (*counts, *scores))

    return Table(
        title=f"By object, {size} px",
        heads=("splats", ".spz, MB", "faces", ".glb, MB", *(f"{method}, dB" for method in methods)),
        rows=tuple((name, cells(row)) for name, row in rows.items()),
    )
