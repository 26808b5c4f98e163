"""``grindvision robots``: the arms that ``groove --robot`` knows by name, with their makers and sources."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

EPILOG = """\
Any other arm is given as a URDF file with its meshes, or as a modified DH table (CSV) with joint limits; the Python
package robot_descriptions fetches URDFs of many arms. Check a table against your arm's data sheet before it moves.

exit code: 0 done, 1 anything else

example:
  grindvision robots --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    parser.add_argument("--json", action="store_true", help="names, tables, frames and sources as JSON")


def run(options: argparse.Namespace) -> int:
    """Run it."""
    from grindvision.motion.known import known_robots

    arms = known_robots()
    if options.json:
        print(json.dumps([asdict(arm) for arm in arms.values()], indent=1))
        return 0
    rows = [("NAME", "MAKER", "MODEL", "--program", "SOURCE")]
    rows += [("ur3", "Universal Robots", "UR3", "urscript", "URDF with meshes, data/robots/ur3")]
    rows += [(arm.name, arm.maker, arm.model, arm.language, arm.source) for arm in arms.values()]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for row in rows:
        print("  ".join([*(word.ljust(width) for word, width in zip(row, widths, strict=False)), row[4]]))
    return 0
