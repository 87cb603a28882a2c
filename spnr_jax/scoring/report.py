"""The report of a run: one HTML file that holds everything, to open from disk, to mail, to keep.

Key numbers and summary, pictures of unseen objects, quality beside the floors, learning curve, settings.  Images are
PNGs inside the page, the curve is an SVG; nothing is loaded from elsewhere, and no script runs.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from spnr_jax.formats.images import depth_image, png_url, to_uint8, write_whole
from spnr_jax.scoring.learning_curve import learning_curve_svg
from spnr_jax.scoring.report_style import STYLE
from spnr_jax.scoring.summary import NO_WEIGHTS

METHODS = {  # method -> its name in tables and pictures, in their order
    "ours": "Ours",
    "surfels": "Surfels",
    "near_points": "Near points",
    "paper": "The paper's network",
    "npbg": "NPBG",
    "point_nerf": "Point-NeRF",
    "points2nerf": "Points2NeRF",
    "nearest": "Nearest-point shading",
    "splat": "Base-colour splat",
    "white": "White image",
}
HIGHER, LOWER = 1, -1  # what is better
QUALITY = {  # metric -> head of its column, decimals, what is better
    "psnr": ("PSNR, dB", 2, HIGHER),
    "ssim": ("SSIM", 3, HIGHER),
    "cpsnr": ("cPSNR, dB", 2, HIGHER),
    "flip": ("FLIP", 3, LOWER),
    "lpips": ("LPIPS", 3, LOWER),
    "iou": ("Opacity IoU", 3, HIGHER),
}
ARROWS = {HIGHER: "\N{UPWARDS ARROW}", LOWER: "\N{DOWNWARDS ARROW}"}
COUNTS = {"objects": "Objects", "views": "Views", "cpsnr_views": "cPSNR views"}
GALLERY_NOTE = (
    "No network saw these objects. The number below a picture is its PSNR in dB. Depth: bright is near, dark is far, "
    "spanning each picture's own range. Opacity: white is solid. Both are those of the first network."
)
QUALITY_NOTE = (
    "Means over images, sRGB in [0, 1] over white. PSNR is capped at 100 dB. SSIM with a Gaussian window of sigma 1.5. "
    "cPSNR is the PSNR over the pixels of visible input points; views without any are left out. FLIP: LDR, 67 pixels "
    "per degree. LPIPS: AlexNet v0.1. Arrows show what is better, the best value of a column is bold. Small: 95 % "
    "bootstrap interval over objects."
)
DIFFERENCES_NOTE = (
    "The first network minus each other method, image by image, so what makes an object hard for both cancels. Small: "
    "95 % bootstrap interval over objects, and the p-value of a sign-flip test over objects."
)


@dataclass(frozen=True, kw_only=True)
class GalleryRow:
    """One view of one object, as the reference and as each method shows it, the networks first.

    Pictures are (h, w, 3), uint8 or float sRGB in [0, 1]; depth and acc (h', w') float are the first network's.
    """

    name: str
    reference: np.ndarray
    images: Mapping[str, np.ndarray]
    depth: np.ndarray
    acc: np.ndarray


def write_report(
    path: str | Path,
    *,
    title: str,
    summary: str,
    settings: Mapping,
    metrics: Mapping,
    gallery: Sequence[GalleryRow],
    curve: Sequence[Mapping],
    per_category: Mapping[str, Mapping] | None = None,
) -> None:
    """Write the page in one piece.

    `metrics` is the content of metrics.json ("methods", the first of which is the network that "NAME_minus" subtracts
    from, "seconds", "preset", "steps", "seed", "hardware"), `per_category` has a "methods" table for every category,
    `curve` the rows of metrics.jsonl, `settings` any nested mapping.  Blank lines in the summary part paragraphs.
    """
    methods = metrics["methods"]
    first = next(iter(methods))
    levels = {METHODS[m]: methods[m]["psnr"] for m in METHODS if m in methods and m != first}
    minus = metrics.get(f"{first}_minus")
    sections = [
        f"<header><h1>{escape(title)}</h1>{_paragraphs(summary)}{_key_numbers(metrics)}</header>",
        _section("Unseen objects", _gallery(gallery), GALLERY_NOTE),
        _section("Quality", _quality_table(methods), QUALITY_NOTE),
        _section("Differences", _difference_table(first, minus), DIFFERENCES_NOTE) if minus else "",
        _section("Quality by category", _category_table(per_category), "PSNR in dB.") if per_category else "",
        _section("Learning curve", f"<figure>{learning_curve_svg(curve, levels)}</figure>", "") if curve else "",
        _section("Run", _definitions(_run_facts(metrics)), ""),
        _section("Settings", _definitions(flatten(settings)), ""),
    ]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body><main>{''.join(sections)}</main></body></html>\n"
    )
    write_whole(Path(path), page.encode())


def flatten(settings: Mapping, prefix: str = "") -> dict[str, object]:
    """The entries of a nested mapping under dotted names."""
    flat: dict[str, object] = {}
    for name, value in settings.items():
        inner = isinstance(value, Mapping) and value
        flat |= flatten(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return flat


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """PSNR in dB, at most 100, of two pictures as the page shows them (8 bit)."""
    squared = float(np.mean((to_uint8(image) / 255 - to_uint8(reference) / 255) ** 2))
    return -10 * math.log10(max(squared, 1e-10))


def duration(seconds: float | int) -> str:
    """Seconds in words: 8.4 s, 6 min 12 s, 2 h 5 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"


def _section(heading: str, body: str, note: str) -> str:
    note = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(heading)}</h2>{note}{body}</section>"


def _paragraphs(text: str) -> str:
    return "".join(f"<p>{escape(part)}</p>" for part in text.split("\n\n") if part.strip())


def _key_numbers(metrics: Mapping) -> str:
    """The numbers that a reader looks for first, as tiles."""
    methods, seconds = metrics["methods"], metrics.get("seconds", {})
    psnr = next(iter(methods.values()))["psnr"]
    tiles = [("PSNR on unseen objects", f"{psnr:.1f} dB")]
    for name, words in (
        ("paper", "over the paper's network"),
        ("white", "over the white image"),
        ("splat", "over the splat"),
        ("nearest", "over nearest point"),
    ):
        if name in list(methods)[1:]:
            tiles.append((words, f"{psnr - methods[name]['psnr']:+.1f} dB"))
    tiles += [(f"to {stage}", duration(seconds[stage])) for stage in ("train", "train paper") if stage in seconds]
    return f'<div class="tiles">{"".join(f"<div><b>{value}</b>{escape(words)}</div>" for words, value in tiles)}</div>'


def _gallery(rows: Sequence[GalleryRow]) -> str:
    methods = rows[0].images if rows else {}
    heads = ["Reference", *(METHODS.get(method, method) for method in methods), "Depth", "Opacity"]
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(_gallery_row(row, heads) for row in rows)
    return f'<table class="gallery"><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>'


def _gallery_row(row: GalleryRow, heads: Sequence[str]) -> str:
    pictures = [(row.reference, "")]
    pictures += [(image, f"{psnr(image, row.reference):.1f}") for image in row.images.values()]
    pictures += [(depth_image(row.depth, row.acc), ""), (row.acc, "")]
    cells = "".join(
        f'<td><img src="{png_url(image)}" '
        f'alt="{escape(row.name)}, {escape(head.lower())}"><small>{caption}</small></td>'
        for head, (image, caption) in zip(heads, pictures, strict=True)
    )
    return f"<tr><th>{escape(row.name)}</th>{cells}</tr>"


def _quality_table(methods: Mapping[str, Mapping]) -> str:
    """Methods against metrics and counts; columns that no method has are left out."""
    quality = [name for name in QUALITY if any(name in scores for scores in methods.values())]
    counts = [name for name in COUNTS if any(name in scores for scores in methods.values())]
    heads = ["", *map(_head, quality), *(COUNTS[name] for name in counts)]
    columns = [_quality_column(name, methods.values()) for name in quality]
    columns += [[escape(str(s.get(name, ""))) for s in methods.values()] for name in counts]
    names = [escape(METHODS.get(method, method)) for method in methods]
    return _table(heads, list(zip(names, *columns, strict=True)))


def _quality_column(name: str, methods: Iterable[Mapping]) -> list[str]:
    """The cells of a metric: the mean and, below it, its interval."""
    _, decimals, better = QUALITY[name]
    means = _bold_best([scores.get(name) for scores in methods], decimals, better, _missing(name))
    intervals = [_interval(scores.get(f"{name}_interval"), decimals) for scores in methods]
    return [f"{mean}{interval}" for mean, interval in zip(means, intervals, strict=True)]


def lowered(method: str) -> str:
    """A method's name inside a sentence."""
    name = METHODS.get(method, method)
    return name if name[:2].isupper() else name[:1].lower() + name[1:]


def _difference_table(first: str, minus: Mapping[str, Mapping]) -> str:
    """Other methods against the difference in each metric."""
    names = [name for name in QUALITY if any(name in row for row in minus.values())]
    rows = []
    for method, row in minus.items():
        cells = [_difference(row.get(name), name) for name in names]
        rows.append((f"{escape(METHODS.get(first, first))} minus {escape(lowered(method))}", *cells))
    return _table(["", *map(_head, names)], rows)


def _difference(found: Mapping | None, name: str) -> str:
    if found is None:
        return _missing(name)
    decimals = QUALITY[name][1]
    p_value = found["p_value"]
    test = (
        "" if p_value is None else f"<small>p {'= ' if p_value >= 0.001 else '&lt; '}{max(p_value, 0.001):.3f}</small>"
    )
    return f"{found['mean']:+.{decimals}f}{_interval(found['interval'], decimals, sign='+')}{test}"


def _head(name: str) -> str:
    text, _, better = QUALITY[name]
    return f"{text}\N{NO-BREAK SPACE}{ARROWS[better]}"


def _missing(name: str) -> str:
    return NO_WEIGHTS if name == "lpips" else "n/a"


def _interval(ends: Sequence[float] | None, decimals: int, sign: str = "") -> str:
    if ends is None:
        return ""
    low, high = (f"{end:{sign}.{decimals}f}" for end in ends)
    return f"<small>[{low}, {high}]</small>"


def _category_table(per_category: Mapping[str, Mapping]) -> str:
    """Categories against the PSNR of every method."""
    methods = list(dict.fromkeys(method for scores in per_category.values() for method in scores))
    rows = []
    for category, scores in per_category.items():
        objects = next((s["objects"] for s in scores.values() if "objects" in s), "")
        values = [scores.get(method, {}).get("psnr") for method in methods]
        rows.append((escape(category), *_bold_best(values, 2), escape(str(objects))))
    return _table(["", *(METHODS.get(method, method) for method in methods), "Objects"], rows)


def _bold_best(values: Sequence[float | None], decimals: int, better: int = HIGHER, missing: str = "n/a") -> list[str]:
    """The values as text, the best in bold; what is missing or not a number is said to be so."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    best = max(finite, default=None, key=lambda value: better * value)
    texts: dict[float | None, str] = {value: f"{value:.{decimals}f}" for value in finite}
    return [f"<b>{texts[v]}</b>" if v is not None and v == best else texts.get(v, missing) for v in values]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already; the first column names the rows."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>" for name, *cells in rows)
    return f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _run_facts(metrics: Mapping) -> dict[str, object]:
    """What made the scores, and how long that took; the rest of metrics.json has tables of its own."""
    shown = ("methods", f"{next(iter(metrics['methods']))}_minus", "per_category", "settings", "seconds")
    facts = {name: value for name, value in metrics.items() if name not in shown}
    times = {f"time to {stage}": duration(seconds) for stage, seconds in metrics.get("seconds", {}).items()}
    if "time to total" in times:
        times["time in total"] = times.pop("time to total")
    return flatten(facts) | times


def _definitions(entries: Mapping[str, object]) -> str:
    items = "".join(f"<div><dt>{escape(str(k))}</dt><dd>{escape(str(v))}</dd></div>" for k, v in entries.items())
    return f"<dl>{items}</dl>"
