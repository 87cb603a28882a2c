"""The wheel holds the two packages and nothing else, and draws a picture where nothing but its dependencies is."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from PIL import Image
from support import tiny_dataset

from data_gen import command

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NO_INDEX = ("No matching distribution", "Could not find a version", "Temporary failure in name", "Connection")


def output_of(*command, **options):
    """What a command says; its errors in full if it fails."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The built wheel; built from a copy, because a build leaves folders behind."""
    source = tmp_path_factory.mktemp("source")
    for folder in ("spnr_jax", "data_gen", "experiments", "tests"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", source / "dist", source]
    done = subprocess.run(command, capture_output=True, text=True)
    if any(words in done.stderr for words in NO_INDEX):
        pytest.skip(f"pip reaches no package index: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    (built,) = (source / "dist").glob("*.whl")
    return built


def find_dependencies():
    """The distributions that the package asks for without its extras, as they lie here, by name."""
    found, asked = {}, [Requirement(line) for line in PROJECT["dependencies"]]
    while asked:
        wanted = asked.pop()
        distribution, name = metadata.distribution(wanted.name), (canonicalize_name(wanted.name), *wanted.extras)
        assert wanted.specifier.contains(distribution.version, prereleases=True), wanted
        if name not in found:
            found[name] = distribution
            further = map(Requirement, distribution.requires or ())
            extras = wanted.extras or ("",)
            asked += [
                one for one in further if not one.marker or any(one.marker.evaluate({"extra": e}) for e in extras)
            ]
    return {name: distribution for (name, *_), distribution in found.items()}


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """The bin folder of an environment with the wheel, links to its dependencies, and nothing else."""
    folder, dependencies = tmp_path_factory.mktemp("environment"), find_dependencies()
    output_of(sys.executable, "-m", "venv", "--without-pip", folder)
    (packages,) = folder.glob("lib/python*/site-packages")
    for distribution in dependencies.values():
        for name in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
            (packages / name).symlink_to(distribution.locate_file(name))
    extras = (line for lines in PROJECT["optional-dependencies"].values() for line in lines)
    along = {canonicalize_name(Requirement(line).name) for line in extras} & dependencies.keys()
    assert along == {"jax"}, "an extra's package came along"
    output_of(sys.executable, "-m", "pip", "--python", folder / "bin" / "python", "install", "--no-deps", wheel)
    return folder / "bin"


def test_the_data_command_knows_the_packages_of_its_extra():
    wanted = PROJECT["optional-dependencies"]["data"]
    assert sorted(command.PACKAGES) == sorted(re.match(r"[\w-]+", entry)[0] for entry in wanted)


@pytest.mark.ci
def test_the_wheel_holds_the_two_packages_of_the_commands_and_all_of_their_files(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"spnr_jax", "data_gen"}
    ours = {
        path.relative_to(ROOT).as_posix()
        for package in ("spnr_jax", "data_gen")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert ours <= set(names)
    for target in PROJECT["scripts"].values():
        assert target.partition(":")[0].replace(".", "/") + ".py" in names


@pytest.mark.ci
def test_in_an_empty_environment_the_wheel_renders_clouds_and_meshes_and_names_the_extra_of_the_rest(
    environment, tmp_path
):
    shutil.copy(tiny_dataset.dataset().folder / "objects" / "chair" / "points.ply", tmp_path / "cloud.ply")
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # it leads to the checkout
    where = {"cwd": tmp_path, "env": variables | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}}
    options = "--views 1 --frames 2 --num-points 64 --resolution 32 --quality draft --no-densify --out pictures"
    output_of(environment / "spnr", "render", "cloud.ply", "mesh.obj", *options.split(), **where)
    for name in ("cloud", "mesh"):
        with Image.open(tmp_path / "pictures" / f"{name}_000.png") as picture:
            pixels = np.asarray(picture)
        assert pixels.shape == (32, 32, 3)
        assert pixels.min() < 250, "all white"
        assert (tmp_path / "pictures" / f"{name}_turntable.gif").is_file()
    output_of(environment / "python", "-c", "import spnr_jax.tools.export", **where)
    command = [environment / "spnr-data", "generate", "out"]
    done = subprocess.run(command, capture_output=True, text=True, **where)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "pip install 'spnr-jax[data]'" in done.stderr
