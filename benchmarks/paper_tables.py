"""The paper's tables and figures with refield: Tables 1, 3 to 8, Figs. 15, 17, 18, and a sheet of pictures.

    python benchmarks/paper_tables.py                              # everything, into docs/results.md and docs/images
    python benchmarks/paper_tables.py --only table3 --worlds cube  # a part; what was run before is shown as well
    python benchmarks/paper_tables.py --dry-run                    # what is still to be run
    python benchmarks/paper_tables.py --folders MINE --only table3 # MINE/{work,after,eval}: your own photos

Fields and photos of the synthetic worlds are made and kept as `estimate.py` does (``--work``). Each result is kept in
``--out`` as soon as it is there: the script may be stopped at any time, and run again it goes on with what is missing.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from estimate import PAPER, Bench
from tables import pictures, show
from tables.cases import Case, folders, worlds
from tables.kept import Kept
from tables.methods import ALIGNMENTS, TRAINING, VIEWS, WHOLE, Lab, run_method
from tables.paper import FIGURE_15, FIGURES_17_18, TABLE_4_SECONDS

from refield.baselines.inpaint import Lama
from refield.field.fit import FitConfig
from refield.scene.errors import InputError
from refield.scene.files import write_bytes
from refield.synthetic.worlds import WORLDS
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperConfig
from refield.vision.perceptual import open_lpips
from refield.vision.weights import WeightsError

ROOT = Path(__file__).resolve().parents[1]
COUNTED = ("cube", "cone")  # worlds of Figs. 17 and 18
SECTIONS: dict[str, tuple[str, ...]] = {
    "table3": ("estimate", "old", "ours", "retrained", "finetuned", "inpainted", "inpainted_photo"),
    "longer": ("estimate", "ours", "retrained", "retrained_long"),
    "table5": ("estimate", "ours", "estimate_unrefined", "no_refine", "no_adjacent", "no_old"),
    "table6": ("estimate",),
    "table7": tuple(f"estimate_{n}_views" for n in VIEWS),
    "table8": ("estimate", "ours", "retrained", "top_views", "usual_views_below"),
    "fig17": tuple(f"true_{n}_views" for n in VIEWS),
}
"""what each needs; Tables 1 and 4, Fig. 15 and the sheet come with ``table3``, what is derived with ``longer``"""
_KNOWN = ("table6", "table7", "table8", "fig17")  # need a world whose change is known
_ONE_SEED = ("longer", "fig17")
_BEGIN, _END = "<!-- paper tables: begin -->", "<!-- paper tables: end -->"


def main() -> int:
    options = _options()
    torch.set_num_threads(options.threads)
    try:
        return _run(options)
    except (InputError, WeightsError) as error:
        print(f"paper_tables: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nstopped; run the same command again to go on", file=sys.stderr)
        return 130


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--worlds", nargs="+", choices=sorted(WORLDS), default=list(PAPER))
    parser.add_argument("--folders", nargs="+", type=Path, default=[], help="each with work/, after/ and eval/")
    parser.add_argument("--seeds", type=int, default=3, help="of each world; longer and fig17: the first")
    parser.add_argument("--size", type=int, default=256, help="pixels a side")
    parser.add_argument("--cameras", type=int, default=70, help="old photos of a world")
    parser.add_argument("--work", type=Path, default=Path("build/estimate-work"), help="worlds' photos and fields")
    parser.add_argument("--out", type=Path, default=Path("build/paper-tables"), help="results of every run")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs" / "results.md", help="images/ lies beside it")
    parser.add_argument("--lpips", type=Path, help="a folder with weights for LPIPS, see docs/weights.md")
    parser.add_argument("--lama", type=Path, help="LaMa's ONNX file, see docs/weights.md")
    parser.add_argument("--steps", type=int, default=FitConfig.steps, help="of re-training and fine-tuning")
    parser.add_argument("--update-steps", type=int, default=HelperConfig.steps)
    parser.add_argument("--looks", type=int, default=16, help="points of a curve")
    parser.add_argument("--threads", type=int, default=min(os.cpu_count() or 1, 2))
    parser.add_argument("--dry-run", action="store_true", help="say what is still to be run, and stop")
    return parser.parse_args()


def _run(options: argparse.Namespace) -> int:
    bench = Bench(options.work, options.out, options.size, options.cameras, options.seeds)
    synthetic = [] if options.folders else worlds(bench, options.worlds, options.seeds)
    cases = [*synthetic, *folders(bench, options.folders)]
    lab = _lab(options)
    todo = [(c, m) for c, m in _plan(options, cases) if lab.kept.get(c.key, m) is None]
    print(f"{len(todo)} runs are missing", flush=True)
    if options.dry_run:
        print(*(f"  {c.key}: {m}" for c, m in todo), sep="\n")
        return 0
    failed = [line for c, m in todo if (line := _one(lab, c, m))]
    found = show.Found(lab.kept, cases)
    _publish(options.docs, found, failed)
    print("", *failed, f"tables: {options.docs}", sep="\n")
    return 1 if failed else 0


def _one(lab: Lab, case: Case, method: str) -> str:
    """Run it; what went wrong, in a line, if something did: the others go on."""
    try:
        run_method(lab, case, method)
    except InputError as error:
        return f"{case.key}, {method}: {error}"
    return ""


def _lab(options: argparse.Namespace) -> Lab:
    return Lab(
        Kept(options.out / f"steps_{options.steps}_{options.update_steps}"),  # never mixed with others
        FitConfig(steps=options.steps),
        # a busy machine must not change what is found
        UpdateConfig(fit=HelperConfig(steps=options.update_steps, max_seconds=600.0)),
        None if options.lpips is None else open_lpips(options.lpips),
        None if options.lama is None else Lama(options.lama),
        options.looks,
    )


def _plan(options: argparse.Namespace, cases: Sequence[Case]) -> list[tuple[Case, str]]:
    """Every case and method that the sections need, each once, case by case."""
    out: dict[tuple[str, str], tuple[Case, str]] = {}
    for case in cases:
        for section in options.only:
            if not _wanted(section, case):
                continue
            more = ("lama_photo",) if section == "table3" and options.lama else ()
            out |= {(case.key, m): (case, m) for m in (*SECTIONS[section], *more)}
    return list(out.values())


def _wanted(section: str, case: Case) -> bool:
    if section in _KNOWN and case.folder is not None:
        return False
    if section in _ONE_SEED and case.seed > 0:
        return False
    return section != "fig17" or case.name in COUNTED


# --- into the document ---


def _publish(docs: Path, found: show.Found, failed: Sequence[str]) -> None:
    """Replace the marked section of a document, or add it at the end; pictures go beside it."""
    images = docs.parent / "images"
    shown = {
        "paper_sheet.png": pictures.sheet(found.kept, _first_seeds(found.cases), images / "paper_sheet.png"),
        "paper_views.png": pictures.number_of_views(found, images / "paper_views.png"),
    }
    for world in found.worlds():
        name = f"paper_convergence_{world}.png"
        shown[name] = pictures.convergence(found, world, images / name)
    text = _section(found, failed, [name for name, there in shown.items() if there])
    section = f"{_BEGIN}\n{text}\n{_END}"
    before = docs.read_text(encoding="utf-8") if docs.is_file() else "# Results\n"
    marked = re.compile(re.escape(_BEGIN) + ".*?" + re.escape(_END), re.DOTALL)
    after = marked.sub(lambda _: section, before) if marked.search(before) else f"{before.rstrip()}\n\n{section}\n"
    write_bytes(docs, after.encode())


def _first_seeds(cases: Sequence[Case]) -> list[Case]:
    return [c for c in cases if c.seed == 0]


def _section(found: show.Found, failed: Sequence[str], images: Sequence[str]) -> str:
    plain, aligned = ALIGNMENTS
    tables: list[tuple[str, str, str]] = [
        ("Tables 1 and 3: quality and time", _ABOUT_3, show.table_3(found, plain)),
        ("Tables 1 and 3, each render aligned to its photo", _ABOUT_ALIGNED, show.table_3(found, aligned)),
        ("Until re-training is as good", _ABOUT_DERIVED, show.catching_up(found)),
        ("Convergence", _ABOUT_CONVERGED, show.converged(found)),
        ("Table 4: seconds of each stage", _ABOUT_4, show.table_4(found)),
        ("Table 5: what is left out", _ABOUT_5, show.table_5(found, plain)),
        ("Table 6: pose errors", "At the object's centre.", show.table_6(found)),
        ("Table 7: pose errors and the number of new photos", "", show.table_7(found)),
        ("Table 8: new photos from above", _ABOUT_8, show.table_8(found, plain)),
        ("Figs. 17 and 18: the update by the true change and the number of new photos", _ABOUT_17,
         show.figures_17_18(found, plain)),
    ]  # fmt: skip
    command = f"python benchmarks/paper_tables.py {shlex.join(sys.argv[1:])}".strip()
    parts = ["## The paper's tables, with refield", f"{show.conditions(found)}.\nCommand: `{command}`. {_ABOUT}"]
    parts += [f"Not run: {line}" for line in failed]
    for title, about, table in tables:
        if table.count("\n") > 1:  # more than a heading
            parts += [f"### {title}", about, table]
    for name in images:
        about = {"paper_sheet.png": _ABOUT_SHEET, "paper_views.png": ""}.get(name, _ABOUT_15)
        parts += [about, f"![{name}](images/{name})"]
    return "\n\n".join(p for p in parts if p) + "\n"


_ABOUT = (
    "Seconds are with compiled kernels. In-masks are where objects are now, out-masks where they were; PSNR pools the "
    "masks' pixels over the evaluation views, SSIM and LPIPS are of their boxes at 256² (§11.2), mean over views. "
    "`±`: standard deviation over seeds of the world. The paper's columns are from NeRFacto at 1024² on a V100, with "
    "other textures and surroundings: they show what the paper saw, not the same task. LPIPS needs weights and is left "
    "out without them."
)
_ABOUT_3 = (
    "Re-trained: a new field from the old photos without the pixels that may show what changed (masks of our estimate, "
    "grown for shadows) and the new photos whole, all pixels drawn alike. Fine-tuned: the old field's weights trained "
    "on with the same data and settings. Both are given the usual number of steps and stop as every fit does. "
    "In-painted: OpenCV's method in the out-mask, of the old field's render, and of the evaluation photo as the "
    "paper does with LaMa, whose figures stand beside it. Totals hold the estimate, whose masks the baselines need "
    "too. Re-training [does better with other settings](#re-training-at-its-best-2026-11-24)."
)
_ABOUT_ALIGNED = "By the homography that correlates them best (§5.3)."
_ABOUT_DERIVED = (
    "Seconds of re-training until it first shows the evaluation photos' regions as well as our finished update does; "
    "`≥` where it never did in the seconds and steps of its row. These are a usual fit's, unless `longer` stands by "
    f"the steps: then it went on for {WHOLE} times our whole update, or {TRAINING} times our training, with a schedule "
    "to match. Our total is estimate and update; the seconds of re-training are without the estimate that it needs as "
    "well."
)
_ABOUT_CONVERGED = (
    "Each training ends by its own rule: when held-out pixels of its inputs stop gaining, or its steps are done. The "
    "paper's rule looks at the evaluation photos: the first look after which SSIM of whole views rises by less than "
    f"0.0005 over a window, here 1/{show.WINDOW} of the steps taken. A dash: not seen before the end. Where a window "
    "holds no look but those at its ends, as ours do, the first look of all may meet the rule: its step says how far "
    "apart looks are, not when training converged. Our seconds are those of the whole update, of which training begins "
    "in the middle."
)
_ABOUT_4 = (
    "Mean over all cases of Table 3. The new photos' poses are given: placing them, for which the paper takes "
    f"{TABLE_4_SECONDS['camera localiz.']} s, was not run."
)
_ABOUT_5 = (
    "Without pose refinement: our initial poses, which already come from a registration of coloured surfaces. Without "
    "adjacent areas: the helper lives in the object's own grid, and old photos teach nothing around it; the last row "
    "leaves out the old photos alone."
)
_ABOUT_8 = "New photos from 64° of elevation in place of 36°, evaluation from below at 15°."
_ABOUT_17 = f"In the paper {FIGURES_17_18}."
_ABOUT_15 = f"Quality over seconds of training (Fig. 15). In the paper {FIGURE_15}."
_ABOUT_SHEET = "Evaluation views; boxes: where the object is now (blue) and where it was (orange)."


if __name__ == "__main__":
    sys.exit(main())
