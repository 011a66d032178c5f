"""The parts of an ament_python package that colcon reads; everything else is in pyproject.toml.

With --symlink-install colcon builds in a folder without pyproject.toml: packages and executables stand here.
"""

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Extension, find_packages, setup

PACKAGE = "umf_ros"
SHARE = f"share/{PACKAGE}"


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """Data files of a folder and its subfolders, under share/umf_ros."""
    folders = [Path(folder), *sorted(path for path in Path(folder).rglob("*") if path.is_dir())]
    files = {path: [str(name) for name in path.glob("*") if name.is_file()] for path in folders}
    return [(f"{SHARE}/{path}", names) for path, names in files.items() if names]


def in_path() -> list[tuple[str, list[str]]]:
    """The `umf` command, where colcon installs: its console scripts are for `ros2 run` alone. pip makes its own."""
    return [("bin", ["tools/umf"])] if {"install", "develop", "symlink_data", "--dry-run"} & set(sys.argv) else []


def nanobind_folder() -> Path:
    """Its headers; colcon runs with the system's Python, where they are those of the active venv."""
    if spec := find_spec("nanobind"):
        return Path(spec.origin).parent
    venv = Path(os.environ.get("VIRTUAL_ENV", "/nowhere"))
    for folder in venv.glob("lib/python3*/site-packages/nanobind"):
        return folder
    raise SystemExit("umf_ros: nanobind is missing, which its compiled part is built with: pip install nanobind")


def kernels() -> Extension:
    """The compiled part: C++17, the same instructions on every machine of an architecture."""
    binding, sources = nanobind_folder(), Path("umf_ros/scan/kernels")
    return Extension(
        "umf_ros.scan._kernels",
        sources=[f"{sources}/module.cpp", f"{sources}/nanobind.cpp"],
        depends=sorted(map(str, sources.glob("*.hpp"))),
        include_dirs=[str(binding / part) for part in ("include", "src", "ext/robin_map/include")],
        extra_compile_args=["-std=c++17", "-O3", "-fvisibility=hidden", "-fno-strict-aliasing", "-ffp-contract=off"],
        define_macros=[("NDEBUG", None)],
        language="c++",
    )


setup(
    name=PACKAGE,
    version=ElementTree.parse("package.xml").findtext("version"),
    license="Apache-2.0",
    python_requires=">=3.11",  # from pyproject.toml it would be an object, and colcon reads literals
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: [f"**/*.{suffix}" for suffix in ("j2", "html", "css", "js", "npz", "pyi")]},
    ext_modules=[kernels()],
    entry_points={
        "console_scripts": [
            "umf = umf_ros.cli:main",
            "loop_closure_node = umf_ros.nodes.start:loop_closure_node",
            "pose_graph_node = umf_ros.nodes.start:pose_graph_node",
            "map_node = umf_ros.nodes.start:map_node",
            "bag_player_node = umf_ros.lab.live:bag_player_node",
        ],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml", "NOTICE"]),
        *shared("config"),
        *shared("launch"),
        *shared("models"),
        *in_path(),
    ],
    zip_safe=False,
)
