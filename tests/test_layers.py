"""What import-linter (`make lint`, the contracts in pyproject.toml) cannot say of the sources and of importing them."""

import ast
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

import spnr_jax

ROOT = Path(__file__).parents[1]
PACKAGES = ("spnr_jax", "data_gen", "experiments")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
HEAVY = {"mitsuba", "pymeshlab", "trimesh", "viser", "torch", "matplotlib", "skimage"}
HEAVY |= {"tensorboardX", "laspy", "imageio_ffmpeg", "DracoPy", "meshoptimizer"}
PURE = ("kernels", "surfels", "nn", "method")
KERNELS = ("cameras", "sampling", "compositing", "voxels", "losses", "metrics")  # of the specification


def of_folders(*folders):
    return [
        path for path in SOURCES if path.relative_to(ROOT).parts[:2] in [("spnr_jax", folder) for folder in folders]
    ]


def test_the_contract_names_every_folder_and_file_below_the_packages():
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]
    named = {name for layer in contract["layers"] for name in layer.split(" | ")}
    places = {path.relative_to(ROOT).with_suffix("").parts[:2] for path in SOURCES}
    assert named == {".".join(place) for place in places if place[1] != "__init__"}


def test_pure_folders_neither_print_nor_open():
    for path in of_folders(*PURE):
        calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
        assert not {"print", "open", "input", "exec", "eval"} & {getattr(call, "id", "") for call in calls}, path


def test_what_programs_are_made_of_is_not_compiled_by_itself():
    assert not [path for path in of_folders("kernels", "nn") if "jax.jit" in path.read_text()]


def test_no_two_modules_share_a_name_none_has_one_of_the_standard_library_and_few_lie_at_the_top():
    names = Counter(path.stem for path in SOURCES if not path.stem.startswith("__"))
    names.update(path.parent.name for path in SOURCES if path.name == "__init__.py")
    assert max(names.values()) == 1
    assert not set(names) & (sys.stdlib_module_names | {"utils", "helpers", "misc", "common"})
    assert all(len(list((ROOT / package).glob("*.py"))) <= 6 for package in PACKAGES)


def modules_after(code):
    """Names of all modules that are loaded when the code has run in a process of its own."""
    program = f"import sys; {code}; print(*sys.modules)"
    return set(subprocess.check_output([sys.executable, "-c", program], text=True, cwd=ROOT).split())


def test_importing_the_package_is_light_and_its_kernels_are_one_module_under_both_names():
    alone = modules_after("import spnr_jax")
    assert not alone & (HEAVY | {"jax", "flax", "optax", "orbax", "scipy"} | {f"spnr_jax.{name}" for name in KERNELS})
    same = (f"from spnr_jax import {name}; import spnr_jax.kernels.{name} as k; assert k is {name}" for name in KERNELS)
    modules_after("; ".join(same))


def test_type_checkers_see_the_names_that_are_imported_at_their_first_use():
    typed = next(node for node in ast.parse(Path(spnr_jax.__file__).read_text()).body if isinstance(node, ast.If))
    seen = {name.asname: node.module for node in typed.body for name in node.names}
    imported = {name: f"spnr_jax.{module}" for name, module in spnr_jax._PUBLIC.items()}
    assert seen == imported | dict.fromkeys(spnr_jax._KERNELS, "spnr_jax.kernels")


@pytest.mark.ci  # it draws one in a process of its own
def test_a_picture_needs_neither_the_paper_s_network_nor_what_trains_or_compares():
    code = (
        "import numpy as np, spnr_jax; spnr_jax.read_cloud; model = spnr_jax.load(); points = np.eye(3, dtype='f'); "
        "volume = model.encode(spnr_jax.make_cloud(points, points), densify=False); "
        "model.render(volume, model.camera(volume, resolution=16), 'draft')"
    )
    loaded = modules_after(code)
    loaded |= modules_after("import spnr_jax.formats.clouds, spnr_jax.tools.pictures, spnr_jax.scoring.report") & HEAVY
    assert not {name.split(".")[0] for name in loaded} & (HEAVY | {"optax", "orbax", "data_gen", "experiments"})
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in SOURCES}
    drawing = loaded & files - {"spnr_jax.training.weights"}
    assert "spnr_jax.method.surfel_renderer" in drawing
    others = {f"spnr_jax.{part}" for part in ("method.paper_method", "method.inference", "nn.paper_layers")}
    assert not drawing & others
    assert not {part for part in drawing if part.split(".")[1] in ("training", "scoring", "tools")}
