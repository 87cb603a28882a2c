"""The wheel holds the two packages and nothing else, and draws a picture where nothing but its dependencies is."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
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


def pip(*arguments):
    """Runs pip; skips where there is no index to install from."""
    options = ("--disable-pip-version-check", "--quiet")
    done = subprocess.run([*map(str, arguments), *options], capture_output=True, text=True)
    if done.returncode and any(words in done.stderr for words in NO_INDEX):
        pytest.skip(f"pip reaches no package index: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The built wheel; built from a copy, because a build leaves folders behind."""
    source = tmp_path_factory.mktemp("source")
    for folder in ("spnr_jax", "data_gen", "experiments", "tests"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    pip(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", source / "dist", source)
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """The bin folder of an empty environment in which the wheel is installed with its dependencies."""
    folder = tmp_path_factory.mktemp("environment")
    output_of(sys.executable, "-m", "venv", folder)
    pip(folder / "bin" / "python", "-m", "pip", "install", "-c", ROOT / "constraints.txt", wheel)
    return folder / "bin"


def clean_environment(**variables):
    """The process's variables without those that lead to this checkout."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "XLA_FLAGS")}
    return kept | variables


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
def test_in_an_empty_environment_the_wheel_renders_clouds_and_meshes_and_exports_splats(environment, tmp_path):
    listed = output_of(environment / "python", "-m", "pip", "list", "--disable-pip-version-check")
    for package in ("mitsuba", "viser", "pymeshlab", "torch", "matplotlib", "tensorboardX", "flip-evaluator"):
        assert package not in listed.split(), "an extra's package came along"
    shutil.copy(tiny_dataset.dataset().folder / "objects" / "chair" / "points.ply", tmp_path / "cloud.ply")
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    options = ["--views", "1", "--frames", "2", "--num-points", "64", "--resolution", "32", "--out", "pictures"]
    variables = clean_environment(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "cache"))
    for name in ("cloud.ply", "mesh.obj"):
        output_of(environment / "spnr", "render", name, *options, cwd=tmp_path, env=variables)
        with Image.open(tmp_path / "pictures" / f"{Path(name).stem}_000.png") as picture:
            pixels = np.asarray(picture)
        assert pixels.shape == (32, 32, 3)
        assert pixels.min() < 250, "all white"
        assert (tmp_path / "pictures" / f"{Path(name).stem}_turntable.gif").is_file()
    few = ["--splats", "splats.ply", "--fitting-views", "4", "--most-splats", "100"]
    output_of(environment / "spnr", "export", "cloud.ply", *few, cwd=tmp_path, env=variables)
    assert (tmp_path / "splats.ply").is_file()


@pytest.mark.ci
@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (("spnr", "view", "cloud.ply"), "viewer"),
        (("spnr", "train", "data", "run"), "train"),
        (("spnr", "evaluate", "data", "run"), "train"),
        (("spnr-data", "generate", "out"), "data"),
    ],
)
def test_what_needs_an_extra_says_so_in_one_line(environment, tmp_path, arguments, extra):
    program, *words = arguments
    done = subprocess.run(
        [environment / program, *words], capture_output=True, text=True, cwd=tmp_path,
        env=clean_environment(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "cache")),
    )  # fmt: skip
    assert done.returncode == 2
    assert f"pip install 'spnr-jax[{extra}]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
