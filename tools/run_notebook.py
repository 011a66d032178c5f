"""Run the code cells of a notebook in order, without Jupyter: `python tools/run_notebook.py NOTEBOOK`.

A line `!COMMAND {name}` runs a command with the values of variables, as in IPython; a failed one ends the run.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

COMMAND = re.compile(r"^(\s*)!(.+)$", re.MULTILINE)
BEFORE = "import matplotlib, subprocess\nmatplotlib.use('agg')"


def main(notebook: Path) -> None:
    """Run a notebook; an exception of a cell is not caught."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {"__name__": "__main__"}
    exec(BEFORE, names)
    for number, cell in enumerate(cells, 1):
        if cell["cell_type"] == "code":
            source = COMMAND.sub(r"\1subprocess.run(f'''\2''', shell=True, check=True)", "".join(cell["source"]))
            exec(compile(source, f"{notebook.name}, cell {number}", "exec"), names)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
