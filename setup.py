"""ament_python package: everything a Jazzy workspace or a plain venv needs."""

import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "umf_ros"


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """Data files of a folder and its subfolders, under share/umf_ros."""
    folders = [Path(folder), *sorted(path for path in Path(folder).rglob("*") if path.is_dir())]
    files = {path: [name for name in glob(f"{path}/*") if Path(name).is_file()] for path in folders}
    return [(f"share/{PACKAGE}/{path}", names) for path, names in files.items() if names]


def required(name: str) -> list[str]:
    """Distributions that a requirements file lists, less its pins: those are what was tested, not what is needed."""
    lines = [line for line in Path(name).read_text(encoding="utf-8").splitlines() if line and line[0] != "#"]
    included = [line.removeprefix("-r ") for line in lines if line.startswith("-r ")]
    own = [line.split("==")[0] for line in lines if not line.startswith("-r ")]
    return [*own, *(package for other in included for package in required(other))]


def in_path() -> list[tuple[str, list[str]]]:
    """The `umf` command, where colcon installs: its console scripts are for `ros2 run` alone. pip makes its own."""
    return [("bin", ["tools/umf"])] if {"install", "develop", "symlink_data"} & set(sys.argv) else []


setup(
    name=PACKAGE,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: [f"**/*.{suffix}" for suffix in ("j2", "html", "css", "js", "npz")]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml", "NOTICE"]),
        *shared("config"),
        *shared("launch"),
        *shared("models"),
        *in_path(),
    ],
    python_requires=">=3.11",
    install_requires=required("requirements.txt"),
    extras_require={
        extra: required(f"requirements-{extra}.txt") for extra in ("ros", "lab", "fleet", "rerun", "peers", "dev")
    },
    zip_safe=True,
    description="Multimodal place recognition and loop closure for rovers with a camera and a LiDAR",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "umf = umf_ros.cli:main",
            "loop_closure_node = umf_ros.nodes.start:loop_closure_node",
            "pose_graph_node = umf_ros.nodes.start:pose_graph_node",
            "bag_player_node = umf_ros.lab.live.start:bag_player_node",
        ],
    },
)
