"""Imports point down the folders, and importing the package stays light: both are read from the source.

A file imports from its own folder and from the entries above its own in the list below, and no files of one folder
import each other in a circle.  Files at the top of a package are entries of their own.
"""

import ast
import functools
import subprocess
import sys
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SPNR_JAX = (
    *("errors", "config", "presets", "methods"),
    *("devices", "kernels", "surfels", "gaussians", "nn", "method"),
    *("formats/mesh", "formats", "training", "scoring", "tools", "viewer"),
    *("cli", "__init__"),
)
DATA_GEN = (
    *("shapes", "procedural", "render", "store", "plan/sources", "plan", "make"),
    *("__main__", "command", "__init__"),
)
QUESTIONS = ("paper", "studies", "speed", "packaged")  # folders of experiments, of which none knows another
EXPERIMENTS = ("__init__", "baselines", "entry_point", "comparison", *QUESTIONS)
ORDER = [
    f"{package}/{entry}"
    for package, entries in {"spnr_jax": SPNR_JAX, "data_gen": DATA_GEN, "experiments": EXPERIMENTS}.items()
    for entry in entries
]
PURE = ("kernels", "surfels", "gaussians", "nn", "method")
WITHOUT_JIT = ("devices", "kernels", "nn")
OF_SPNR_JAX = {
    "spnr_jax/errors",
    "spnr_jax/devices",
    "spnr_jax/kernels",
    "spnr_jax/surfels",
    "spnr_jax/formats",
    "spnr_jax/formats/mesh",
}  # that data_gen stands on
IMPURE = {"os", "pathlib", "time", "io", "sys", "json", "shutil", "tempfile", "logging", "datetime", "random", "tqdm"}
HEAVY = {"mitsuba", "pymeshlab", "trimesh", "viser", "torch", "matplotlib", "skimage", "grain", "dask", "distributed"}


def sources(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imports(tree: ast.AST) -> set[str]:
    """Dotted names of everything that is imported below a node, `from a import b` as both a and a.b."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def entry_of(path: Path) -> str:
    """The folder of a file from the root, or the file itself at the top of a package."""
    place = path.relative_to(ROOT)
    if place.parts[0] == "data_gen" and place.parts[1] == "procedural":
        return "data_gen/procedural"
    return place.parent.as_posix() if len(place.parts) > 2 else place.with_suffix("").as_posix()


PACKAGE = [path for folder in ("spnr_jax", "data_gen", "experiments") for path in sources(folder)]
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in PACKAGE}
named = {"ids": lambda path: "/".join(path.relative_to(ROOT).parts)}


@functools.cache
def own_imports(path: Path) -> frozenset[Path]:
    """The files of the project that a file imports; of a folder, what its __init__.py holds."""
    names = {name for name in imports(parsed(path)) if name in MODULES}
    # `from a import b` of a module b reads nothing from a
    inner = {name for name in names if any(other.startswith(f"{name}.") for other in names)}
    return frozenset(MODULES[name] for name in names - inner)


def test_the_order_names_every_folder_once_and_nothing_else():
    assert max(Counter(ORDER).values()) == 1
    assert {entry_of(path) for path in PACKAGE} == set(ORDER)


@pytest.mark.parametrize("path", PACKAGE, **named)
def test_imports_point_down_the_folders(path):
    here = entry_of(path)
    for there in own_imports(path):
        above = ORDER.index(entry_of(there)) <= ORDER.index(here)
        assert above, f"{here} imports {there.relative_to(ROOT)}, which stands below it in the list"


@pytest.mark.parametrize("entry", ORDER)
def test_the_files_of_a_folder_do_not_import_each_other_in_a_circle(entry):
    files = [path for path in PACKAGE if entry_of(path) == entry]
    graph = {path: own_imports(path) & set(files) - {path} for path in files}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(path.name for path in error.args[1]))


@pytest.mark.parametrize("path", sources("spnr_jax"), **named)
def test_spnr_jax_knows_neither_data_gen_nor_experiments(path):
    assert not {name.split(".")[0] for name in imports(parsed(path))} & {"data_gen", "experiments"}


@pytest.mark.parametrize("path", sources("data_gen"), **named)
def test_data_gen_stands_on_kernels_and_formats_alone(path):
    assert not {name.split(".")[0] for name in imports(parsed(path))} & {"experiments"}
    entries = {entry_of(there) for there in own_imports(path)}
    assert {entry for entry in entries if entry.startswith("spnr_jax/")} <= OF_SPNR_JAX


@pytest.mark.parametrize("folder", QUESTIONS)
def test_an_experiment_knows_no_other_question(folder):
    entries = {entry_of(there) for path in sources(f"experiments/{folder}") for there in own_imports(path)}
    assert not entries & {f"experiments/{other}" for other in QUESTIONS if other != folder}


@pytest.mark.parametrize("path", [path for folder in PURE for path in sources(f"spnr_jax/{folder}")], **named)
class TestPureFolders:
    def test_touch_no_files_clocks_or_global_randomness(self, path):
        modules = {name.split(".")[0] for name in imports(parsed(path))}
        assert not modules & (IMPURE | HEAVY)

    def test_neither_print_nor_open(self, path):
        calls = {
            node.func.id
            for node in ast.walk(parsed(path))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not calls & {"print", "open", "input", "exec", "eval"}


def test_what_programs_are_made_of_is_not_compiled_by_itself():
    for path in (path for folder in WITHOUT_JIT for path in sources(f"spnr_jax/{folder}") if path.stem != "traces"):
        assert "jax.jit" not in path.read_text(), path


def test_the_tops_of_the_packages_hold_at_most_six_files():
    for package in ("spnr_jax", "data_gen", "experiments"):
        assert len(list((ROOT / package).glob("*.py"))) <= 6


def test_no_two_modules_share_a_name_and_none_has_one_of_the_standard_library():
    names = Counter(path.stem for path in PACKAGE if not path.stem.startswith("__"))
    names.update({path.parent.name for path in PACKAGE if path.name == "__init__.py"})
    assert not [name for name, count in names.items() if count > 1]
    assert not set(names) & sys.stdlib_module_names


def test_no_file_is_a_drawer_for_everything():
    assert not {path.stem for path in PACKAGE} & {"utils", "helpers", "misc", "common"}


def modules_after(code: str) -> set[str]:
    """Names of all modules that are loaded when the code has run in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return set(done.stdout.split())


def test_importing_the_package_loads_no_heavy_module():
    assert not modules_after("import spnr_jax") & (HEAVY | {"jax", "flax", "optax", "orbax", "scipy"})


def test_a_picture_needs_nothing_that_trains_or_compares():
    loaded = modules_after("import spnr_jax, spnr_jax.method.model; spnr_jax.load, spnr_jax.read_cloud")
    assert not {name.split(".")[0] for name in loaded} & (HEAVY | {"optax", "orbax", "data_gen", "experiments"})
    assert not loaded & {"spnr_jax.nn.discriminator", "spnr_jax.training.trainer", "spnr_jax.training.optimisation"}


def own_code(names: set[str]) -> set[str]:
    """Modules of the package that hold code: the __init__ of a folder holds a docstring."""
    return {name for name in names if name.startswith("spnr_jax.") and MODULES[name].name != "__init__.py"}


def test_a_picture_is_drawn_without_the_paper_s_network_and_what_trains():
    code = (
        "import numpy as np, spnr_jax; model = spnr_jax.load(); points = np.eye(3, dtype=np.float32); "
        "cloud = spnr_jax.PointCloud(positions=points, base_color=points, roughness=points[0], metallic=points[0], "
        "mask=np.ones(3, bool)); volume = model.encode(cloud); "
        "model.render(volume, model.camera(volume, resolution=16), 'draft')"
    )
    drawing = own_code(modules_after(code)) - {"spnr_jax.training.weights"}
    assert "spnr_jax.method.surfel_renderer" in drawing
    others = {f"spnr_jax.{part}" for part in ("method.paper_method", "method.inference", "nn.encoder", "nn.unet3d")}
    assert not drawing & others
    assert not {part for part in drawing if part.split(".")[1] in ("training", "scoring", "tools")}


def test_the_kernels_of_the_specification_are_one_module_under_both_names():
    names = "cameras", "sampling", "compositing", "voxels", "losses", "metrics"
    checks = (
        f"from spnr_jax import {name}; import spnr_jax.kernels.{name} as full; assert spnr_jax.{name} is {name} is full"
        for name in names
    )
    loaded = modules_after("import spnr_jax; assert 'jax' not in sys.modules; " + "; ".join(checks))
    assert not {f"spnr_jax.{name}" for name in names} & loaded
