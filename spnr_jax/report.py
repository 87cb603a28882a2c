"""The report of a run: one HTML file that holds everything, to open from disk, to mail, to keep.

Key numbers and summary, pictures of unseen objects, quality beside the floors, learning curve, settings.  Images are
PNGs inside the page, the curve is an SVG; nothing is loaded from elsewhere, and no script runs.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from spnr_jax.images import depth_image, png, to_uint8, write_whole
from spnr_jax.learning_curve import learning_curve_svg
from spnr_jax.report_style import STYLE

METHODS = {"ours": "Ours", "nearest": "Nearest-point shading", "splat": "Base-colour splat", "white": "White image"}
QUALITY = {"psnr": ("PSNR, dB", 2), "ssim": ("SSIM", 3), "cpsnr": ("cPSNR, dB", 2), "iou": ("Opacity IoU", 3)}
COUNTS = {"objects": "Objects", "views": "Views", "cpsnr_views": "cPSNR views"}
GALLERY_HEADS = ("Reference", "Ours", "Base-colour splat", "Nearest point", "Depth", "Opacity")
GALLERY_NOTE = (
    "The network never saw these objects. The number below a picture is its PSNR in dB. Depth: bright is near, dark "
    "is far, spanning each picture's own range. Opacity: white is solid."
)
QUALITY_NOTE = (
    "PSNR on sRGB in [0, 1] over white, mean over images, capped at 100 dB. SSIM with a Gaussian window of sigma 1.5. "
    "cPSNR is the PSNR over the pixels of visible input points; views without any are left out. Higher is better, the "
    "best value of a column is bold."
)


@dataclass(frozen=True, kw_only=True)
class GalleryRow:
    """One view of one object: pictures (h, w, 3), uint8 or float sRGB in [0, 1]; depth and acc (h', w') float."""

    name: str
    reference: np.ndarray
    ours: np.ndarray
    splat: np.ndarray
    nearest: np.ndarray
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

    `metrics` is the content of metrics.json ("methods" of METHODS, "seconds", "preset", "steps", "seed", "hardware"),
    `per_category` has a "methods" table for every category, `curve` the rows of metrics.jsonl, `settings` any nested
    mapping.  Blank lines in the summary part paragraphs.
    """
    methods = metrics["methods"]
    floors = {METHODS[m]: methods[m]["psnr"] for m in ("nearest", "splat", "white") if m in methods}
    sections = [
        f"<header><h1>{escape(title)}</h1>{_paragraphs(summary)}{_key_numbers(metrics)}</header>",
        _section("Unseen objects", _gallery(gallery), GALLERY_NOTE),
        _section("Quality", _quality_table(methods), QUALITY_NOTE),
        _section("Quality by category", _category_table(per_category), "PSNR in dB.") if per_category else "",
        _section("Learning curve", f"<figure>{learning_curve_svg(curve, floors)}</figure>", "") if curve else "",
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
    ours = methods["ours"]["psnr"]
    tiles = [("PSNR on unseen objects", f"{ours:.1f} dB")]
    for name, words in (
        ("white", "over the white image"),
        ("splat", "over the splat"),
        ("nearest", "over nearest point"),
    ):
        if name in methods:
            tiles.append((words, f"{ours - methods[name]['psnr']:+.1f} dB"))
    tiles += [(f"to {stage}", duration(seconds[stage])) for stage in ("train",) if stage in seconds]
    return f'<div class="tiles">{"".join(f"<div><b>{value}</b>{escape(words)}</div>" for words, value in tiles)}</div>'


def _gallery(rows: Sequence[GalleryRow]) -> str:
    heads = "".join(f"<th>{head}</th>" for head in GALLERY_HEADS)
    body = "".join(_gallery_row(row) for row in rows)
    return f'<table class="gallery"><thead><tr><th></th>{heads}</tr></thead><tbody>{body}</tbody></table>'


def _gallery_row(row: GalleryRow) -> str:
    pictures = [(row.reference, "")]
    pictures += [(image, f"{psnr(image, row.reference):.1f}") for image in (row.ours, row.splat, row.nearest)]
    pictures += [(depth_image(row.depth, row.acc), ""), (row.acc, "")]
    cells = "".join(
        f'<td><img src="data:image/png;base64,{base64.b64encode(png(image)).decode()}" '
        f'alt="{escape(row.name)}, {head.lower()}"><small>{caption}</small></td>'
        for head, (image, caption) in zip(GALLERY_HEADS, pictures, strict=True)
    )
    return f"<tr><th>{escape(row.name)}</th>{cells}</tr>"


def _quality_table(methods: Mapping[str, Mapping]) -> str:
    """Methods against metrics and counts; columns that no method has are left out."""
    quality = [name for name in QUALITY if any(name in scores for scores in methods.values())]
    counts = [name for name in COUNTS if any(name in scores for scores in methods.values())]
    heads = ["", *(QUALITY[name][0] for name in quality), *(COUNTS[name] for name in counts)]
    columns = [_bold_best([s.get(name) for s in methods.values()], QUALITY[name][1]) for name in quality]
    columns += [[escape(str(s.get(name, ""))) for s in methods.values()] for name in counts]
    names = [escape(METHODS.get(method, method)) for method in methods]
    return _table(heads, list(zip(names, *columns, strict=True)))


def _category_table(per_category: Mapping[str, Mapping]) -> str:
    """Categories against the PSNR of every method."""
    methods = list(dict.fromkeys(method for scores in per_category.values() for method in scores))
    rows = []
    for category, scores in per_category.items():
        objects = next((s["objects"] for s in scores.values() if "objects" in s), "")
        values = [scores.get(method, {}).get("psnr") for method in methods]
        rows.append((escape(category), *_bold_best(values, 2), escape(str(objects))))
    return _table(["", *(METHODS.get(method, method) for method in methods), "Objects"], rows)


def _bold_best(values: Sequence[float | None], decimals: int) -> list[str]:
    """The values as text, the highest in bold; what is missing or not a number is n/a."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    best = max(finite, default=None)
    texts: dict[float | None, str] = {value: f"{value:.{decimals}f}" for value in finite}
    return [f"<b>{texts[v]}</b>" if v is not None and v == best else texts.get(v, "n/a") for v in values]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already; the first column names the rows."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr><th>{name}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>" for name, *cells in rows)
    return f'<table class="numbers"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _run_facts(metrics: Mapping) -> dict[str, object]:
    """Everything of metrics.json but the table of methods: what made it, and how long that took."""
    facts = {name: value for name, value in metrics.items() if name not in ("methods", "seconds")}
    times = {f"time to {stage}": duration(seconds) for stage, seconds in metrics.get("seconds", {}).items()}
    if "time to total" in times:
        times["time in total"] = times.pop("time to total")
    return flatten(facts) | times


def _definitions(entries: Mapping[str, object]) -> str:
    items = "".join(f"<div><dt>{escape(str(k))}</dt><dd>{escape(str(v))}</dd></div>" for k, v in entries.items())
    return f"<dl>{items}</dl>"
