"""Amazon Berkeley Objects: the products of the 3D download (abo-3dmodels.tar, unpacked).

    3dmodels/metadata/3dmodels.csv.gz (or .csv)   3dmodel_id,path,meshes,materials,... ; path from 3dmodels/original
    3dmodels/original/L/B01N2PLWIL.glb            one product a file, sorted into folders by the id's last letter

The product's id is its 3dmodel_id. The metadata decide what is a product: a row without its file is an object that is
left out, and so is a .glb without a row; both are reported. glTF is y up, metres.
"""

import csv
import gzip
import re
import zlib
from pathlib import Path

from data_gen.plan.sources.listing import Listed, described
from spnr_jax.errors import UserError

FOLDER = "3dmodels"
FILE = re.compile(r"([\w-]+/)*[\w-]+(\.[\w-]+)*")  # no way up, and none from the root
LONGEST_TABLE = 2**28  # bytes, unpacked; ABO's has a million
TABLES = ("metadata/3dmodels.csv.gz", "metadata/3dmodels.csv")


def find_products(root: Path) -> list[Listed]:
    """Every product below a root (the folder that holds `3dmodels`, or `3dmodels` itself), sorted by id."""
    folder = root / FOLDER if (root / FOLDER).is_dir() else root
    table = next((folder / name for name in TABLES if (folder / name).is_file()), None)
    models = folder / "original"
    if table is None or not models.is_dir():
        raise UserError(
            f"--root {root}: expected {FOLDER}/original/*/*.glb and {FOLDER}/{TABLES[0]}, as in the ABO 3D download; "
            f"{described(root)}"
        )
    products = []
    for object_id, name in read_table(table).items():
        path = models / name
        fault = "" if path.is_file() else f"{table.name} lists it, but there is no file {FOLDER}/original/{name}"
        products.append(Listed(object_id=object_id, path=path, folder=path.parent, fault=fault))
    known = {product.path for product in products}
    for path in sorted(set(models.glob("*/*.glb")) - known):
        fault = f"has no row in {table.name}"
        products.append(Listed(object_id=path.stem, path=path, folder=path.parent, fault=fault))
    return sorted(products, key=lambda product: product.object_id)


def read_table(table: Path) -> dict[str, str]:
    """The .glb file of each product, relative to 3dmodels/original; ValueError if the table is not ABO's."""
    try:
        with gzip.open(table) if table.suffix == ".gz" else table.open("rb") as file:
            text = file.read(LONGEST_TABLE)
        rows = list(csv.DictReader(text.decode("utf-8").splitlines()))
    except (OSError, EOFError, UnicodeDecodeError, zlib.error, csv.Error) as error:
        raise UserError(f"{table}: cannot be read ({error}); unpack the download again") from None
    names: dict[str, str] = {}
    for number, row in enumerate(rows, start=2):
        object_id, name = row.get("3dmodel_id"), row.get("path")
        if not object_id or not name:
            raise UserError(f"{table}, line {number}: expected columns 3dmodel_id and path; unpack the download again")
        if object_id in names:
            raise UserError(f"{table}, line {number}: product {object_id} is listed twice; unpack the download again")
        if not FILE.fullmatch(name):
            raise UserError(f"{table}, line {number}: {name!r} is no file below 3dmodels/original; unpack it again")
        names[object_id] = name
    return names
