"""One HTML file with tables, and unseen objects x methods to flip through beside the reference.

Nothing is loaded from elsewhere: pictures are PNGs inside the file, and so is the script.  Left and right change the
method, up and down the object; holding the space bar, or the mouse on the picture, shows the reference in its place.
Without scripts the tables are still there.
"""

from collections.abc import Sequence
from pathlib import Path

from experiments.comparison.object_scores import Shown
from spnr_jax.formats.images import png_url
from spnr_jax.formats.pages import template
from spnr_jax.scoring.report import Table


def page(title: str, tables: Sequence[Table], notes: Sequence[str], shown: Sequence[Shown] = ()) -> str:
    """The whole file; without pictures if no object is to be shown."""
    pictures = {
        "methods": list(shown[0].images) if shown else [],
        "objects": [
            {
                "name": row.name,
                "view": row.view,
                "reference": png_url(row.reference),
                "images": {method: png_url(image) for method, image in row.images.items()},
                "psnr": {method: round(value, 2) for method, value in row.psnr.items()},
            }
            for row in shown
        ],
    }
    return template(Path(__file__).with_name("page.html")).render(
        title=title, tables=tables, notes=notes, pictures=pictures
    )
