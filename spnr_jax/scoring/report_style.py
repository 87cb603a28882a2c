"""The look of pages: one style sheet, light, no fonts or files from elsewhere; and their templates."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

STYLE = """
:root { --ink: #1d2330; --soft: #5b6475; --line: #e3e7ee; --paper: #fff; --ground: #f5f6f8; --accent: #2457d6 }
* { box-sizing: border-box }
body { margin: 0; background: var(--ground); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", "Helvetica Neue", Arial, "Liberation Sans", sans-serif }
main { max-width: 1180px; margin: 0 auto; padding: 32px 20px 64px }
header, section { background: var(--paper); border: 1px solid var(--line); border-radius: 10px;
  padding: 22px 26px; margin-bottom: 18px }
h1 { font-size: 26px; line-height: 1.25; letter-spacing: -.01em; margin: 0 0 8px }
h2 { font-size: 18px; margin: 0 0 4px }
p { max-width: 78ch; margin: 0 0 10px }
.note { color: var(--soft); font-size: 13px; margin-bottom: 14px }
.tiles { display: flex; flex-wrap: wrap; gap: 10px; margin-top: 16px }
.tiles div { flex: 1 1 130px; background: var(--ground); border-radius: 8px; padding: 10px 14px;
  color: var(--soft); font-size: 13px }
.tiles b { display: block; color: var(--ink); font-size: 23px; font-weight: 650; line-height: 1.3;
  font-variant-numeric: tabular-nums }
.tiles div:first-child b { color: var(--accent) }
table { border-collapse: collapse }
thead th { color: var(--soft); font-size: 13px; font-weight: 600; text-align: right; vertical-align: bottom }
.gallery { width: 100%; table-layout: fixed }
.gallery thead th { position: sticky; top: 0; z-index: 1; background: var(--paper); text-align: center;
  padding: 8px 4px; box-shadow: 0 1px 0 var(--line) }
.gallery tbody th { font-size: 13px; font-weight: 600; text-align: left; overflow-wrap: anywhere; padding-right: 8px }
.gallery td { padding: 8px 4px 2px; text-align: center; vertical-align: top }
.gallery img { display: block; width: 100%; max-width: 150px; margin: 0 auto; image-rendering: pixelated;
  border: 1px solid var(--line); border-radius: 4px }
.gallery small { display: block; min-height: 1.5em; color: var(--soft); font-size: 12px;
  font-variant-numeric: tabular-nums }
.numbers { min-width: 60%; font-variant-numeric: tabular-nums }
.numbers th, .numbers td { padding: 7px 10px; text-align: right; border-bottom: 1px solid var(--line) }
.numbers tbody > tr > * { vertical-align: top }
.numbers th:first-child { padding-left: 0; text-align: left }
.numbers tbody th { font-weight: 500; white-space: nowrap }
.numbers small { display: block; color: var(--soft); font-size: 12px; white-space: nowrap }
.numbers tbody tr:last-child > * { border-bottom: 0 }
figure { margin: 8px 0 0 }
figure svg { width: 100%; height: auto }
figure svg text { font-family: inherit !important }
dl { columns: 340px; column-gap: 36px; margin: 8px 0 0; font-size: 13px }
dl div { display: flex; gap: 12px; justify-content: space-between; break-inside: avoid; padding: 3px 0;
  border-bottom: 1px dotted var(--line) }
dt { color: var(--soft); overflow-wrap: anywhere }
dd { margin: 0; max-width: 65%; text-align: right; overflow-wrap: anywhere }
@media (max-width: 700px) {
  main { padding: 12px 8px 40px }
  header, section { padding: 16px 12px }
  .gallery thead th { font-size: 10px }
  .gallery tbody th { font-size: 10px }
  .gallery td { padding: 6px 2px 0 }
  .numbers { display: block; overflow-x: auto; white-space: nowrap }
}
@media print { body { background: none } header, section { border: 0; padding: 10px 0 } tr { break-inside: avoid } }
"""


def template(path: Path) -> Template:
    """The template of a page in a file; a name that it uses and is not given is an error."""
    return Environment(
        loader=FileSystemLoader(path.parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(path.name)
