"""Fail unless a demo's summary shows true closures, no false one, and a straightened trajectory."""

import json
import sys
from pathlib import Path

summary = json.loads((Path(sys.argv[1]) / "summary.json").read_text())
truth = summary["ground_truth"]
checks = {
    "at least 5 true closures": truth["closures_true"] >= 5,
    "no false closure": truth["closures_false"] == 0,
    "optimised error below half of the odometry's": truth["ate_optimized_m"] < 0.5 * truth["ate_odometry_m"],
}
for name, passed in checks.items():
    sys.stdout.write(f"{'ok  ' if passed else 'FAIL'} {name}\n")
sys.exit(not all(checks.values()))
