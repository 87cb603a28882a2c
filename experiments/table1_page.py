"""The page of Table 1: the tables, and unseen objects x methods to flip through beside the reference.

One HTML file that loads nothing: pictures are PNGs inside it, and so is the script.  Left and right change the method,
up and down the object; holding the space bar, or the mouse on the picture, shows the reference in its place.
Without scripts the tables are still there.
"""

import base64
import json
from collections.abc import Sequence
from html import escape

import numpy as np

from experiments.table1_report import LABELS, Cell, Table
from experiments.table1_scores import Shown
from spnr_jax.formats.images import png
from spnr_jax.scoring.report_style import STYLE

TITLE = "Table 1: every method on the same unseen objects"
HELP = (
    "Left and right: method. Up and down: object. Hold the space bar, or the mouse on the right picture, to see the "
    "reference in its place. Shown is the view whose PSNR is the median of the first method's, and "
    "its PSNR in dB."
)
PAGE_STYLE = """
main { max-width: 1500px }
.scroll { overflow-x: auto }
.best { font-weight: 700 }
.best small { font-weight: 400 }
.numbers td { white-space: nowrap }
.pair { display: flex; flex-wrap: wrap; gap: 18px; margin: 12px 0 }
.pair figure { margin: 0 }
.pair img { width: min(384px, 42vw); image-rendering: pixelated; border: 1px solid var(--line); border-radius: 6px;
  display: block; user-select: none }
.pair figcaption { margin-top: 6px }
.strip { display: flex; flex-wrap: wrap; gap: 8px; margin: 8px 0 }
.strip button { border: 2px solid transparent; border-radius: 8px; background: var(--ground); padding: 5px;
  width: 112px; font: inherit; font-size: 12px; line-height: 1.35; color: var(--soft); cursor: pointer }
.strip button[aria-pressed="true"] { border-color: var(--accent); color: var(--ink) }
.strip img { width: 96px; height: 96px; display: block; margin: 0 auto 3px; image-rendering: pixelated }
.objects { max-height: 270px; overflow-y: auto }
.objects button { width: 106px; overflow-wrap: anywhere }
.objects img { width: 68px; height: 68px }
"""
SCRIPT = """
const {objects, methods, labels} = JSON.parse(document.getElementById('pictures').textContent);
const element = id => document.getElementById(id);
let object = 0, method = 0, peek = false;
function button(strip, picture, text, choose) {
  const made = document.createElement('button'), image = document.createElement('img');
  image.src = picture; image.alt = '';
  made.append(image, text); made.onclick = choose;
  strip.append(made);
}
function show() {
  const shown = objects[object], name = methods[method];
  element('reference').src = shown.reference;
  element('picture').src = peek ? shown.reference : shown.images[name];
  element('picture').alt = (peek ? 'reference' : labels[name]) + ', ' + shown.name;
  element('what').textContent = 'Reference: ' + shown.name + ', view ' + shown.view;
  element('who').textContent = peek ? 'Reference' : labels[name] + ', ' + shown.psnr[name].toFixed(1) + ' dB';
  element('methods').replaceChildren();
  methods.forEach((name, i) => button(element('methods'), shown.images[name],
    labels[name] + ' ' + shown.psnr[name].toFixed(1), () => { method = i; show(); }));
  for (const [id, chosen] of [['methods', method], ['objects', object]])
    [...element(id).children].forEach((made, i) => made.setAttribute('aria-pressed', i === chosen));
}
function turn(key) {
  const [down, right] = {ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0]}[key];
  method = (method + right + methods.length) % methods.length;
  object = (object + down + objects.length) % objects.length;
  show();
  if (down) element('objects').children[object].scrollIntoView({block: 'nearest'});
}
function look(reference) { if (peek !== reference) { peek = reference; show(); } }
objects.forEach((shown, i) => button(element('objects'), shown.reference, shown.name, () => { object = i; show(); }));
document.addEventListener('keydown', event => {
  if (event.key.startsWith('Arrow')) { event.preventDefault(); turn(event.key); }
  if (event.key === ' ') { event.preventDefault(); look(true); }
});
document.addEventListener('keyup', event => { if (event.key === ' ') { event.preventDefault(); look(false); } });
element('picture').onpointerdown = event => { event.preventDefault(); look(true); };
document.addEventListener('pointerup', () => look(false));
show();
"""


def page(tables: Sequence[Table], notes: Sequence[str], shown: Sequence[Shown]) -> str:
    """The whole file; without pictures if no object is to be shown."""
    listed = "".join(f"<li>{escape(note)}</li>" for note in notes)
    parts = [f"<header><h1>{escape(TITLE)}</h1>{_table(tables[0])}</header>"]
    if shown:
        parts.append(_viewer(shown))
    parts += [f"<section><h2>{escape(table.title)}</h2>{_table(table)}</section>" for table in tables[1:]]
    parts.append(f'<section><h2>How these were measured</h2><ul class="note">{listed}</ul></section>')
    script = f"<script>{SCRIPT}</script>" if shown else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(TITLE)}</title><style>{STYLE}{PAGE_STYLE}</style></head>"
        f"<body><main>{''.join(parts)}</main>{script}</body></html>\n"
    )


def _viewer(shown: Sequence[Shown]) -> str:
    """The part with the pictures; they lie in it as JSON."""
    methods = list(shown[0].images)
    objects = [
        {
            "name": row.name,
            "view": row.view,
            "reference": data_address(row.reference),
            "images": {method: data_address(row.images[method]) for method in methods},
            "psnr": {method: round(row.psnr[method], 2) for method in methods},
        }
        for row in shown
    ]
    content = {"objects": objects, "methods": methods, "labels": {name: LABELS[name] for name in methods}}
    packed = json.dumps(content, allow_nan=False).replace("<", "\\u003c")  # no name may end the element
    return (
        f'<section><h2>Unseen objects</h2><p class="note">{escape(HELP)}</p>'
        '<div class="pair"><figure><img id="reference" alt="reference"><figcaption id="what"></figcaption></figure>'
        '<figure><img id="picture" alt=""><figcaption id="who"></figcaption></figure></div>'
        '<div class="strip" id="methods"></div><div class="strip objects" id="objects"></div>'
        f'<script type="application/json" id="pictures">{packed}</script></section>'
    )


def data_address(image: np.ndarray) -> str:
    """The image (h, w, 3) as an address that holds it as PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in ("", *table.heads))
    rows = "".join(f"<tr><th>{escape(name)}</th>{_cells(cells, len(table.heads))}</tr>" for name, cells in table.rows)
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    inner = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f'{note}<div class="scroll"><table class="numbers">{inner}</table></div>'


def _cells(cells: Sequence[Cell], columns: int) -> str:
    """The cells of a row; a single one spans them all."""
    span = f' colspan="{columns}"' if len(cells) < columns else ""
    return "".join(
        f"<td{span}{' class=best' * cell.best}>{escape(cell.text)}"
        + "".join(f"<small>{escape(text)}</small>" for text in cell.small)
        + "</td>"
        for cell in cells
    )
