"""Templates of pages that load nothing from elsewhere; their look is one style sheet, pages.css: light, no fonts."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template


def template(path: Path) -> Template:
    """The template of a page in a file; a name that it uses and is not given is an error."""
    return Environment(
        loader=FileSystemLoader([path.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(path.name)
