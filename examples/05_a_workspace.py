"""A workspace that the command line made, from Python: look at its visits, render them, update it, take that back.

Run:  refield demo work
      python examples/05_a_workspace.py work OUT [PHOTOS]
PHOTOS are a few new photos of the scene; with them the workspace gets a visit, as from `refield update work PHOTOS`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import refield


def main(work: str, out: Path, photos: str | None = None) -> None:
    scene = refield.open(work)
    print(scene)
    if photos is not None:
        made = scene.update(photos, on_stage=lambda stage: print(f"  {stage} …"))
        print(f"{made}; its report is {made.html}")

    for visit in scene.visits:
        print(visit)
        for thing in visit.change.objects:
            print(f"  {thing}")

    # the scene as it was and as it is, from where an old photo was taken
    view = scene.capture().held_out[0]
    before, now = scene.render(view, visit=0), scene.render(view)
    refield.write_image(out / "before.png", before.rgb)
    refield.write_image(out / "now.png", now.rgb)
    middle = now.depth.median()
    refield.write_image(out / "nearness.png", middle / (middle + now.depth))

    # and from elsewhere: the same camera, a step to the right (axes are OpenCV's: x right, y down, z forward)
    pose = view.world_from_cam.clone()
    pose[:3, 3] += 0.05 * scene.world.size * pose[:3, 0]
    refield.write_image(out / "aside.png", scene.render(view.camera, pose).rgb)
    print(f"pictures in {out}")

    if photos is not None:
        print(f"visit {scene.undo()} is taken back: {scene}")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    try:
        main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:4])
    except refield.InputError as error:  # one line: where, what, what to do
        sys.exit(str(error))
