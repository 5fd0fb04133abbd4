"""How good a field of photographs is: the product's own fit, judged by photos that were left out of it.

    python benchmarks/fields.py DATA... [--quality draft good best] [--train "--fit.seed 1"]
    python benchmarks/fields.py DATA... --exposure 0               # exposure and white balance put off at random first
    python benchmarks/fields.py DATA... --against-nerfacto         # NeRFacto's shape as well, for as long
    python benchmarks/fields.py WORK...                            # workspaces, judged as they are

DATA is what `refield train` takes. Each fit is a process of its own; its workspace, what it said, its row and a sheet
of pictures (sheet.png) are in ``--out``/NAME/QUALITY, all rows in ``--out``/fields.json, the tables in fields.md. Poses
are found once for a capture: the first fit's seconds and memory hold that.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    arguments = _parser().parse_args()
    from fields.run import Asked, rows_of
    from fields.tell import MEASURES, curves_tables, fits_table
    from own_photos import conditions

    from refield.scene.errors import InputError

    asked = Asked(
        out=arguments.out.resolve(),
        qualities=tuple(arguments.quality or (None,)),
        train=tuple(shlex.split(arguments.train)),
        exposure=arguments.exposure,
        against=arguments.against_nerfacto,
        longest=arguments.longest,
    )
    rows: list[dict[str, Any]] = []
    try:
        for data in arguments.data:
            for row in rows_of(data, asked):
                rows.append(row)
                print(f"{row['name']}, {row['how']}: done", file=sys.stderr, flush=True)
    except InputError as error:
        print(f"fields: {error}", file=sys.stderr)
        return 2
    tables = [conditions().strip(), MEASURES, fits_table(rows), curves_tables(rows)]
    text = "\n\n".join(t for t in tables if t is not None) + "\n"
    asked.out.mkdir(parents=True, exist_ok=True)
    (asked.out / "fields.json").write_text(json.dumps(rows, indent=1), encoding="utf-8")
    (asked.out / "fields.md").write_text(text, encoding="utf-8")
    print(json.dumps(rows, indent=1) if arguments.json else text)
    return 1 if any("failed" in row for row in rows) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", type=Path, metavar="DATA", help="a capture, or a workspace")
    parser.add_argument("--quality", nargs="+", help="of `refield train`; several are a fit each")
    parser.add_argument("--train", default="", help="further options of `refield train`, in one string")
    parser.add_argument("--exposure", type=int, metavar="SEED", help="put exposure and white balance off at random")
    parser.add_argument(
        "--against-nerfacto",
        nargs="?",
        const="nerfacto",
        choices=["nerfacto", "nerfacto-reduced"],
        help="fit this architecture too, for as long as the last of the others",
    )
    parser.add_argument("--longest", type=int, default=1600, help="larger photos are judged at so many pixels a side")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "fields", help="workspaces, sheets, rows, tables")
    parser.add_argument("--json", action="store_true", help="print the rows, not the tables")
    return parser


if __name__ == "__main__":
    sys.exit(main())
