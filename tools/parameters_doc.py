"""Write docs/parameters.md from the settings' own descriptions.

python tools/parameters_doc.py            writes the file
python tools/parameters_doc.py --check    fails when the file is out of date
"""

import sys
from pathlib import Path

from pydantic import BaseModel

from umf_ros.core.config import Settings

TARGET = Path(__file__).parent.parent / "docs" / "parameters.md"
HEAD = """# Parameters

The same names work as ROS parameters of both nodes (`-p loop.top_k:=10`), in a parameter file
(`config/loop_closure.yaml`), and in the file given to `umf replay --config`. Whole numbers are accepted
where a float is expected; unknown names and wrong types are refused with a message.
"""


def table(group: type[BaseModel], prefix: str) -> list[str]:
    """Rows of one group."""
    rows = ["| parameter | default | meaning |", "|---|---|---|"]
    for name, field in group.model_fields.items():
        default = "" if field.default == "" else f"`{field.default}`"
        rows.append(f"| `{prefix}{name}` | {default} | {field.description} |")
    return rows


def text() -> str:
    """The whole document."""
    groups = {name: field for name, field in Settings.model_fields.items() if isinstance(field.default, BaseModel)}
    plain = [name for name in Settings.model_fields if name not in groups]
    rows = [line for line in table(Settings, "") if line[:3] != "| `" or line[3:].split("`")[0] in plain]
    lines = [HEAD, *rows]
    for name, field in groups.items():
        lines += ["", f"## {name}", "", field.annotation.__doc__ or "", "", *table(field.annotation, f"{name}.")]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if "--check" not in sys.argv:
        TARGET.write_text(text(), encoding="utf-8")
    elif TARGET.read_text(encoding="utf-8") != text():
        sys.exit("docs/parameters.md is out of date: run python tools/parameters_doc.py")
