"""Whose a folder of results is: what is asked for stands in a file there, and another request is refused.

What was made for the request is kept there too, so that the same command goes on.
"""

import json
from collections.abc import Callable
from pathlib import Path

from spnr_jax.formats.images import write_whole


def claim(path: Path, asked: dict, what: str) -> None:
    """Makes the file's folder that of a request; ValueError if it is another's, whose results would be mixed in."""
    if path.is_file():
        there = json.loads(path.read_text())
        if different := [name for name in asked if there.get(name) != asked[name]]:
            raise ValueError(f"{path.parent} holds {what} with another {', '.join(different)}; choose another --out")
    write_whole(path, (json.dumps(asked, indent=1) + "\n").encode())


def kept(place: Path, make: Callable[[], dict]) -> dict:
    """The content of a JSON file, which is made if it is not there."""
    if not place.is_file():
        write_whole(place, (json.dumps(make(), indent=1) + "\n").encode())
    return json.loads(place.read_text())
