"""Imports point down the layers, and importing the package stays light: both are read from the source.

0 types model_config config distributed | 1 numerics and its sibling kernels | 2 nn/ and kernels made of kernels
3 renderer baselines | 4 training
5 data checkpoint clouds evaluation model and what else reads or writes files | 6 cli report results trainer experiments
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = {
    0: {"types", "config", "model_config", "distributed"},
    1: {
        *("numerics", "cameras", "colors", "compositing", "losses", "metrics", "resizing", "sampling", "statistics"),
        *("subsample", "voxels"),
    },
    2: {"nn", "empty_space", "surface", "supersampling", "flip", "lpips"},
    3: {"renderer", "baselines"},
    4: {"training"},
    6: {"cli", "report", "results", "runs_command", "trainer"},
}
FILES = 5  # every module that is not named above reads or writes files
# what siblings below the files may import
SHARED = {0: {"model_config", "types"}, 1: {"numerics"}, 2: {"convolution", "encoding", "normalization"}}
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


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def parts(path: Path) -> list[str]:
    """Names below the package: spnr_jax/nn/field.py is [nn, field]."""
    return list(path.relative_to(ROOT / "spnr_jax").with_suffix("").parts)


def layer_of(name: str) -> int:
    return next((level for level, names in LAYERS.items() if name in names), FILES)


PACKAGE = [path for path in sources("spnr_jax") if path.name != "__init__.py"]
MODULES = {parts(path)[0] for path in PACKAGE}
named = {"ids": lambda path: "/".join(path.relative_to(ROOT).parts)}


@pytest.mark.parametrize("path", PACKAGE, **named)
def test_imports_point_down_the_layers(path):
    here = parts(path)
    level = layer_of(here[0])
    for there in (name.split(".")[1:] for name in imports(parsed(path)) if name.startswith("spnr_jax.")):
        if there[0] not in MODULES or len(there) < len(here):
            continue  # a name of the package itself, or the folder that the file stands in
        assert layer_of(there[0]) <= level, f"layer {level} imports {'.'.join(there)} of layer {layer_of(there[0])}"
        if layer_of(there[0]) == level < FILES:
            sibling = (
                there[1] if len(here) > 1 else there[0]
            )  # nn/field.py and nn/unet3d.py, or cameras.py and voxels.py
            assert sibling in SHARED.get(level, set()), f"{here[-1]} imports its sibling {'.'.join(there)}"


@pytest.mark.parametrize("path", [path for path in PACKAGE if layer_of(parts(path)[0]) <= 4], **named)
class TestPureLayers:
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


def test_only_training_and_what_stands_above_it_compiles():
    for path in PACKAGE:
        if layer_of(parts(path)[0]) < 4:
            assert "jax.jit" not in path.read_text(), path


def test_the_layers_name_no_module_that_does_not_exist():
    assert set().union(*LAYERS.values()) <= MODULES


def test_importing_the_package_loads_no_heavy_module():
    code = f"import sys, spnr_jax; print(*({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert not done.stdout.split()


@pytest.mark.parametrize("path", sources("data_gen"), **named)
def test_data_gen_stands_on_layers_0_and_1_alone(path):
    for name in imports(parsed(path)):
        package, *there = name.split(".")
        if package == "spnr_jax" and there:
            assert layer_of(there[0]) <= 1, f"{path.name} imports {name}"
        assert package != "experiments"


@pytest.mark.parametrize("path", sources("spnr_jax"), **named)
def test_data_gen_is_loaded_by_the_reader_of_clouds_alone_and_only_on_demand(path):
    tree = parsed(path)
    inside = set().union(*(imports(n) for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)), set())
    everywhere = {name for name in imports(tree) if name.split(".")[0] in ("data_gen", "experiments")}
    if path.name == "clouds.py":
        assert everywhere <= inside, "at import, or in a class body"
    else:
        assert not everywhere


def test_no_file_is_a_drawer_for_everything():
    names = {path.stem for folder in ("spnr_jax", "data_gen", "experiments") for path in sources(folder)}
    assert not names & {"utils", "helpers", "misc", "common"}
