"""One HTML file with tables, and unseen objects x methods to flip through beside the reference.

Nothing is loaded from elsewhere: pictures are PNGs inside the file, and so is the script.  Left and right change the
method, up and down the object; holding the space bar, or the mouse on the picture, shows the reference in its place.
Without scripts the tables are still there.
"""

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from experiments.comparison.scoring import Shown
from experiments.comparison.tables import Table
from spnr_jax.formats.images import png
from spnr_jax.scoring.report_style import STYLE

ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def page(title: str, tables: Sequence[Table], notes: Sequence[str], shown: Sequence[Shown] = ()) -> str:
    """The whole file; without pictures if no object is to be shown."""
    pictures = {
        "methods": list(shown[0].images) if shown else [],
        "objects": [
            {
                "name": row.name,
                "view": row.view,
                "reference": address(row.reference),
                "images": {method: address(image) for method, image in row.images.items()},
                "psnr": {method: round(value, 2) for method, value in row.psnr.items()},
            }
            for row in shown
        ],
    }
    template = ENVIRONMENT.get_template("page.html")
    return template.render(title=title, tables=tables, notes=notes, pictures=pictures, style=STYLE)


def address(image: np.ndarray) -> str:
    """The image (h, w, 3) as an address that holds it as PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"
