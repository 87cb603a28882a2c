"""What a source knows of its objects before any is read."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Listed:
    """One object of a source: its mesh file, the folder that its files lie in, or why it cannot be used."""

    object_id: str
    path: Path
    folder: Path
    fault: str = ""


def described(folder: Path, most: int = 5) -> str:
    """What a folder holds, for a message to somebody who expected something else."""
    if not folder.is_dir():
        return "there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"it holds {', '.join(names[:most])}{more}" if names else "it is empty"
