"""tf2_msgs/TFMessage, built by ROS's own generators where Jazzy comes from PyPI, which lacks that package."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np

NAME = "tf2_msgs"
IDL = """#include "geometry_msgs/msg/TransformStamped.idl"
module tf2_msgs { module msg { struct TFMessage { sequence<geometry_msgs::msg::TransformStamped> transforms; }; }; };
"""
PREFIX = Path(sys.prefix)
PARTS = ("generator", "fastrtps", "introspection", "dispatch")
"""Folders of sources; two generators write files of the same name."""
GEOMETRY = ("generator_c", "generator_py", "typesupport_c", "typesupport_fastrtps_c", "typesupport_introspection_c")
RUNTIME = ("runtime_c", "typesupport_c", *(f"typesupport_{name}" for name in ("fastrtps_c", "fastrtps_cpp")))
LIBRARIES = (
    *(f"geometry_msgs__rosidl_{name}" for name in GEOMETRY),
    *(f"rosidl_{name}" for name in (*RUNTIME, "typesupport_introspection_c")),
    *("rcutils", "rmw", "fastcdr"),
)


def build(folder: Path) -> None:
    """Generate and compile the package into an empty folder, which then belongs into PYTHONPATH."""
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    os.environ.setdefault("AMENT_PREFIX_PATH", str(PREFIX))
    (folder / "idl/msg").mkdir(parents=True)
    (folder / "idl/msg/TFMessage.idl").write_text(IDL)
    given = NAME, [f"{folder / 'idl'}:msg/TFMessage.idl"], [str(PREFIX / "share")]
    generator, fastrtps, introspection, dispatch = sources = [folder / part / NAME for part in PARTS]
    package = folder / NAME
    for path in (*sources, package):
        path.mkdir(parents=True)
    kinds = [f"rosidl_typesupport_{name}_c" for name in ("fastrtps", "introspection")]
    GenerateC("").generate(*given, generator, HashTypeDescription("").generate_type_hashes(*given, generator))
    GenerateFastRTPSCTypesupport("").generate(*given, fastrtps)
    GenerateIntrospectionCTypesupport("").generate(*given, introspection)
    GenerateCTypesupport("", typesupport_implementations=kinds).generate(*given, dispatch)
    GeneratePython("", typesupport_implementations=["rosidl_typesupport_c"]).generate(*given, package)
    (package / "__init__.py").touch()
    own = [f"{NAME}__rosidl_generator_c"]
    _link(folder, generator, f"lib{own[0]}.so", [])
    for path, kind in zip((fastrtps, introspection), kinds, strict=True):
        _link(folder, path, f"lib{NAME}__{kind}.so", own)
    own += [f"{NAME}__{kind}" for kind in kinds]
    _link(folder, dispatch, f"lib{NAME}__rosidl_typesupport_c.so", own)
    _link(folder, package, f"{NAME}_s__rosidl_typesupport_c.so", [*own, f"{NAME}__rosidl_typesupport_c"])


def _link(folder: Path, sources: Path, name: str, own: list[str]) -> None:
    """Compile the sources in a folder into a library of the package."""
    places = [PREFIX / "include", *(PREFIX / "include").iterdir(), *(folder / part for part in PARTS)]
    places += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    files = [path for path in sorted(sources.rglob("*.c*")) if path.suffix in (".c", ".cpp")]
    compiled = [word for path in files for word in ("-x", "c" if path.suffix == ".c" else "c++", str(path))]
    paths = [f"-L{PREFIX / 'lib'}", f"-L{folder / NAME}", f"-Wl,-rpath,{PREFIX / 'lib'}", "-Wl,-rpath,$ORIGIN"]
    linked = [f"-Wl,-soname,{name}", "-Wl,--no-as-needed", *(f"-l{library}" for library in (*own, *LIBRARIES))]
    out = ["-o", str(folder / NAME / name)]
    includes = [f"-I{path}" for path in places]
    command = ["g++", "-shared", "-fPIC", "-w", *includes, *compiled, "-x", "none", *paths, *linked, *out]
    subprocess.run(command, check=True)
