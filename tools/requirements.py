"""Check that requirements*.txt pin the requirements of pyproject.toml; `--write` makes them.

pyproject.toml is the one list, with lower bounds. Each pinned file holds the newest versions that pip finds for a part
of it; requirements-jazzy.txt those that go with an installed Jazzy (Ubuntu 24.04, Python 3.12, NumPy 1.26.4).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
RUNTIME = "dependencies"


@dataclass(frozen=True)
class Pinned:
    """A pinned file.

    Attributes:
        part: the extra of pyproject.toml that it pins, or `RUNTIME`.
        about: comment at its head.
        includes: names of the pinned files that it reads; all are resolved together.
        fixed: versions that are given.
    """

    part: str
    about: str
    includes: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()


FILES = {
    "requirements.txt": Pinned(
        RUNTIME,
        "needed on a rover; ROS 2 itself comes from an installed Jazzy or from requirements-ros.txt",
    ),
    "requirements-jazzy.txt": Pinned(
        RUNTIME,
        "beside an installed Jazzy (Ubuntu 24.04, Python 3.12), in a venv made with --system-site-packages:\n"
        "tools/install_jazzy.sh does it all. NumPy stays below 2, as the system's cv_bridge and others need it. On\n"
        "aarch64 the same set has wheels; openvino asks for glibc 2.35, and without it torch runs the network\n"
        "(requirements-torch.txt)",
        fixed=("numpy==1.26.4",),
    ),
    "requirements-ros.txt": Pinned("ros", "ROS 2 Jazzy from PyPI, where Jazzy itself is not installed"),
    "requirements-demo.txt": Pinned(
        "demo",
        "for make demo, with the renderer of the simulator",
        includes=("requirements.txt", "requirements-ros.txt"),
    ),
    "requirements-torch.txt": Pinned(
        "torch",
        "networks without a model for OpenVINO, and a GPU;\n"
        "tools/install_torch.sh installs the CPU build: a plain torch pulls gigabytes of CUDA",
    ),
    "requirements-lab.txt": Pinned("lab", "simulation, training and evaluation"),
    "requirements-fleet.txt": Pinned("fleet", "a fleet's PostgreSQL, and many machines; a single rover needs neither"),
    "requirements-elevation.txt": Pinned("elevation", "elevation models as GeoTIFF"),
    "requirements-rerun.txt": Pinned("rerun", "umf replay --rerun; asks for NumPy 2"),
    "requirements-peers.txt": Pinned(
        "peers", "other systems of benchmarks/accuracy/systems.py, in an environment of their own"
    ),
    "requirements-dev.txt": Pinned(
        "dev",
        "everything, with tests, lint and packaging checks",
        includes=tuple(f"requirements-{part}.txt" for part in ("demo", "torch", "lab", "rerun", "fleet", "elevation")),
    ),
}
HEAD = "made by tools/requirements.py from pyproject.toml: "


def wanted(part: str) -> dict[str, Requirement]:
    """Requirements of a part of pyproject.toml by canonical name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] if part == RUNTIME else project["optional-dependencies"][part]
    return {canonicalize_name(one.name): one for one in map(Requirement, lines)}


def pins(name: str) -> list[str]:
    """Lines of a pinned file that name a requirement."""
    path = ROOT / name
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [line for line in lines if line and not line.startswith(("#", "-r "))]


def faults(name: str) -> list[str]:
    """Differences of a pinned file from the list, one line each."""
    path, bounds = ROOT / name, wanted(FILES[name].part)
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    included = {line.removeprefix("-r ") for line in lines if line.startswith("-r ")}
    pinned = {canonicalize_name(one.name): one for one in map(Requirement, pins(name))}
    found = [f"{one} is missing" for key, one in bounds.items() if key not in pinned]
    found += [f"{one.name} is not in pyproject.toml" for key, one in pinned.items() if key not in bounds]
    found += [f"{one} is missing" for one in FILES[name].fixed if one not in map(str, pinned.values())]
    found += [f"-r {one} is wrong" for one in sorted(included ^ set(FILES[name].includes))]
    for key in pinned.keys() & bounds.keys():
        versions = [one.version for one in pinned[key].specifier if one.operator == "=="]
        if len(versions) != 1 or not bounds[key].specifier.contains(versions[0]):
            found.append(f"{pinned[key]} does not pin {bounds[key]}")
        if pinned[key].extras != bounds[key].extras:
            found.append(f"{pinned[key]} has other extras than {bounds[key]}")
        if pinned[key].marker != bounds[key].marker:
            found.append(f"{pinned[key]} is for other machines than {bounds[key]}")
    return [f"{name}: {one}" for one in found]


def resolved(names: list[str]) -> dict[str, str]:
    """The newest versions that go together, by canonical name, for this Python; pins of other machines stay."""
    lines = [str(one) for name in names for one in wanted(FILES[name].part).values()]
    lines += [one for name in names for one in FILES[name].fixed]
    pip = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    report = json.loads(subprocess.check_output([*pip, *lines], text=True))["install"]
    kept = [Requirement(line) for name in names for line in pins(name)]
    versions = {canonicalize_name(one.name): next(iter(one.specifier)).version for one in kept if one.marker}
    return versions | {canonicalize_name(one["metadata"]["name"]): one["metadata"]["version"] for one in report}


def write(name: str, versions: dict[str, str]) -> None:
    """Write a pinned file."""
    about = [f"# {line}" for line in (HEAD + FILES[name].about).splitlines()]
    included = [f"-r {one}" for one in FILES[name].includes]
    lines = []
    for key, one in sorted(wanted(FILES[name].part).items()):
        extras = f"[{','.join(sorted(one.extras))}]" if one.extras else ""
        marker = f"; {one.marker}" if one.marker else ""
        lines.append(f"{one.name}{extras}=={versions[key].split('+')[0]}{marker}")
    (ROOT / name).write_text("\n".join([*about, *included, *lines]) + "\n", encoding="utf-8")


def main() -> int:
    """Check or write the pinned files; 1 if a check fails."""
    parser = argparse.ArgumentParser(description="Check that requirements*.txt pin the requirements of pyproject.toml.")
    parser.add_argument("--write", action="store_true", help="resolve them anew with pip and write the files")
    if parser.parse_args().write:
        together = [*FILES["requirements-dev.txt"].includes, "requirements-dev.txt"]
        for names in (together, ["requirements-jazzy.txt"], ["requirements-peers.txt"]):
            versions = resolved(names)
            for name in names:
                write(name, versions)
    found = [one for name in FILES for one in faults(name)]
    for one in found:
        print(one, file=sys.stderr)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
