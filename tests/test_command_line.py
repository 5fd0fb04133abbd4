"""What every command has in common: its help, what programs are told, exit codes, near misses, completion."""

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import tyro

from refield.cli import COMMANDS, main
from refield.commands import update
from refield.commands.answer import Exit
from refield.commands.brief import options_of
from refield.commands.clock import Clock
from refield.commands.completion import script
from refield.commands.options import Output, kind_of, names, parsed, shown
from refield.field.fit import FitProgress
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import did_you_mean
from refield.visits import make
from tests.conftest import HERE, TINY_FIT
from tests.test_cli import FEW, believing, place  # noqa: F401

OPTION = re.compile(r"--[a-z][\w.-]*")
LONGEST = 40  # lines of a short help, on a terminal of 80 columns


def help_of(command, option="--help"):
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit) as caught:
        main([command, option])
    assert caught.value.code == 0
    return said.getvalue()


def options_in(text):
    """Of the lines, in a box or without, that begin with some."""
    lines = [line.strip("│| ") for line in text.splitlines() if re.match("[│| ] -", line)]
    return {name for line in lines for name in OPTION.findall(line.split("  ")[0])} - {"--help", "--help-all"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_short_and_says_how_to_begin(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")  # wide enough for no second column
    brief, whole = help_of(command), help_of(command, "--help-all")
    assert len(brief.splitlines()) <= LONGEST and max(map(len, brief.splitlines())) <= 80
    assert len(options_in(brief)) <= 25
    assert f"examples:\n  refield {command}" in brief
    assert not re.search(r"§|\bEq\. |\bFig\. ", brief + whole)
    assert {"--json", "--quiet", "--verbose"} <= options_in(brief) <= options_in(whole)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_the_short_help_shows_is_told_in_four_lines(command):
    for option in (option for option in options_of(kind_of(command)) if option.usual):
        assert option.told and len(option.in_short()) < 4 * 58, option.name


def test_the_short_help_shows_first_sentences_and_defaults(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = help_of("train").splitlines()
    at = lines.index("  --fit.max-seconds NUMBER")
    assert lines[at + 1].strip() == "stop after so long"
    assert "  --poses.photos.longest INT" in lines and "(default: 1600)" in help_of("train")
    assert "  --no-placed         the new photos" in help_of("rehearse") and "0 is" in help_of("render")
    assert "in the world random (default: 0)" in " ".join(help_of("synth").split())


@pytest.mark.parametrize("command", COMMANDS)
def test_the_full_help_names_what_is_accepted_and_nothing_else(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    said = io.StringIO()
    with contextlib.redirect_stdout(said), pytest.raises(SystemExit):
        tyro.cli(kind_of(command), args=["--help"], prog="it")  # the very type that is parsed
    assert options_in(help_of(command, "--help-all")) == options_in(said.getvalue())
    hidden = len(names(kind_of(command))) - len(names(kind_of(command), whole=False))
    assert (f"{hidden} more options" in help_of(command)) == (hidden > 0)


def test_what_the_short_help_hides_is_accepted_as_before():
    asked = parsed(
        kind_of("update"), ["w", "p", "--estimate.paper.detect.align.inliers", "7", "--update.supervise.far", "2"], "u"
    )
    assert asked.estimate.paper.detect.align.inliers == 7 and asked.update.supervise.far == 2
    asked = parsed(kind_of("train"), ["d", "--nerfacto.field.proposals.1.levels", "3", "--fit.photos.no-poses"], "t")
    assert asked.nerfacto.field.proposals[1].levels == 3 and not asked.fit.photos.poses


def test_every_command_takes_what_all_take():
    for command in COMMANDS:
        assert kind_of(command).__dataclass_fields__["output"].default == Output()
        assert issubclass(shown(kind_of(command)), kind_of(command))


def told(capsys, *argv, code=0):
    """The one document on stdout."""
    assert main([*argv, "--json"]) == code
    document = json.loads(capsys.readouterr().out)
    assert "error" in document or document["seconds"] >= 0
    return document


def test_programs_are_told_of_visits(place, monkeypatch, capsys):  # noqa: F811
    believing(monkeypatch, "moved", "added")
    first = told(capsys, "update", "work", "new", "--evaluation", "new", "--exit-code", *FEW, code=Exit.CHANGED)
    assert first["visit"] == 1 and [o["kind"] for o in first["objects"]] == ["moved", "added"] and first["changed"]
    assert [(p["name"], p["status"]) for p in first["photos"]][-1] == ("images/003.png", "rejected")
    assert first["evaluation"]["pooled"]["psnr"] > 0 and Path(first["report"]).is_file()
    assert set(update._USUAL) & {"freeze", "train", "show", "report"} <= first["seconds_per_stage"].keys()
    believing(monkeypatch)
    assert main(["update", "work", "new", "--exit-code"]) == Exit.DONE
    capsys.readouterr()
    listed = told(capsys, "visits", "work")["visits"]
    assert listed[0]["objects"] == first["objects"] and [v["changed"] for v in listed] == [True, False]
    assert listed[1]["why"] == "nothing changed: because"
    assert main(["visits", "work"]) == 0
    assert "nothing changed: because" in capsys.readouterr().out
    assert told(capsys, "report", "work")["visits"] == 2
    undone = told(capsys, "undo", "work")
    assert undone.pop("seconds") < 60 and undone == {"workspace": "work", "undone": 2, "visits": 1}
    pictures = told(capsys, "render", "work", "--cameras", "new/transforms.json", "--out", "pictures")["pictures"]
    assert sorted(Path("pictures").iterdir()) == [Path(p) for p in pictures] and len(pictures) == 4
    scores = told(capsys, "evaluate", "work", "new", "--out", "scores.json")
    written = json.loads(Path("scores.json").read_text())
    assert {key: scores[key] for key in written} == written and scores["visit"] == 1


def test_what_is_not_understood_has_its_own_code(place, monkeypatch, capsys):  # noqa: F811
    def estimate(capture, field, frames, config, on_stage=None, models=None, known=(), on_count=None):
        photos = tuple(PlacedPhoto(f.name, "used", "", f) for f in frames)
        return SceneChange((), photos, "who knows", unexplained=(torch.ones(24, 32, dtype=torch.bool),) * len(frames))

    monkeypatch.setattr(make, "estimate_change", estimate)
    document = told(capsys, "update", "work", "new", "--exit-code", code=Exit.UNCLEAR)
    assert document["not_understood"] and not document["changed"]
    assert main(["visits", "work"]) == 0
    assert "something changed that is not understood" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_programs_are_told_of_trainings_and_checks(place, capsys):  # noqa: F811
    trained = told(capsys, "train", "data", "out", *TINY_FIT)
    field = json.loads(Path("out/field/field.json").read_text())
    assert trained["held_out_psnr"] == pytest.approx(field["held_out_psnr"]) and trained["photos"] > 2
    looked = told(capsys, "check", "data", "--picture", "cameras.png")
    assert looked["usable"] and len(looked["photos"]) == trained["photos"] and Path(looked["picture"]).is_file()
    assert looked["memory_bytes"] > 0 and looked["seconds_expected"]["fit"] > 0
    Path("few").mkdir()
    shutil.copy(
        "data/images/000.png" if Path("data/images/000.png").is_file() else next(Path("data").rglob("*.png")), "few"
    )
    bad = told(capsys, "check", "few", code=2)
    assert not bad["usable"] and bad["error"]["where"] == "few" and bad["faults"][0] in bad["error"]["remedy"]


@pytest.mark.parametrize(
    ("argv", "where"),
    [
        (["visits", "nowhere"], "nowhere"),
        (["render", "work", "--cameras", "none.json", "--out", "o"], "none.json"),
        (["update", "work", "new", "--no-such-option"], "refield update"),
        (["synth", "cube", "o", "--size", "1"], "--size"),
    ],
)
def test_programs_are_told_what_is_wrong(place, capsys, argv, where):  # noqa: F811
    try:
        code = main([*argv, "--json"])
    except SystemExit as stop:
        code = stop.code
    said = capsys.readouterr()
    fault = json.loads(said.out)["error"]
    assert code == 2 and fault["where"] == where and fault["what"] and fault["remedy"] and said.err


def test_quiet_and_verbose(place, capsys):  # noqa: F811
    argv = ["render", "work", "--cameras", "new/transforms.json", "--out", "pictures"]
    assert main([*argv, "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.err == "" and said.out == "4 pictures in pictures\n"
    assert main([*argv, "--verbose", "--visit", "0"]) == 0
    said = capsys.readouterr()
    assert "torch" in said.err and "visit: 0" in said.err and re.search(r"\d s, \d+ MB at most so far", said.err)
    assert said.out == "4 pictures in pictures\n"


def test_warnings_are_heard_where_it_is_quiet(capsys):
    clock = Clock(quiet=True)
    clock.stage("look")
    clock.warn("mind the step")
    assert capsys.readouterr().err == "warning: mind the step\n"


def test_a_fit_whose_time_was_over_early_says_so():
    with Clock(quiet=True).training("fit") as line:
        for step, left, cut in ((29, 0.0, 0.29), (29, 3.0, None), (80, 0.0, None), (100, 0.0, None)):
            line(FitProgress(step, 100, 12.3, 1e3, 40.0, 55.0, left))
            assert line.cut_short == cut


def test_stages_tell_how_long_is_left(capsys):
    clock = Clock()
    clock.expect({"one": 0.1, "two": 200, "three": 100})
    for stage in ("before", "one", "two", "three"):
        clock.stage(stage)
        time.sleep(0.01)
    clock.expect({"one": 10, "two": 20}, sure=10)
    clock.stage("two")
    lines = capsys.readouterr().err.splitlines()
    assert not any("left" in line for line in lines[:3])  # a thousandth of it tells nothing
    left = re.search(r"three \(about (\d+) s left\)", lines[3])
    assert left is not None and int(left[1]) < 5  # they went faster
    assert re.search(r"two \(about (8|9|10|11) s left\)", lines[4])


def test_the_stages_expected_of_an_update_are_its_stages():
    source = "".join(p.read_text() for p in Path(update.__file__).parent.parent.rglob("*.py"))
    assert not [name for name in update._USUAL if f'("{name}")' not in source]


@pytest.mark.parametrize(
    ("given", "meant"), [("updat", "update"), ("visit", "visits"), ("trian", "train"), ("frobnicate", None)]
)
def test_commands_that_are_nearly_right(capsys, given, meant):
    assert main([given]) == 2
    said = capsys.readouterr().err
    assert (f"did you mean {meant!r}?" in said) == (meant is not None) and "choose one of demo" in said


def test_photos_and_options_that_are_nearly_right(place, capsys):  # noqa: F811
    cameras = ["render", "work", "--cameras", "new/transforms.json", "--out", "o"]
    assert main([*cameras, "--look", "0000.jpg"]) == 2
    assert re.search(r"did you mean 'images/0000.png'\?", capsys.readouterr().err)
    with pytest.raises(SystemExit):
        main(["update", "work", "new", "--evalution", "new"])
    assert "--evaluation" in capsys.readouterr().err
    assert did_you_mean("img_20", ["images/IMG_0020.JPG", "b.png"]) == "did you mean 'images/IMG_0020.JPG'? "


def test_whoever_stops_reading_gets_no_traceback():
    code = "import sys; from refield.cli import main; sys.exit(main(['--help']))"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=HERE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == Exit.PIPE
    process.stderr.close()


def test_doctor(tmp_path, capsys):
    document = told(capsys, "doctor")
    assert document["can_run"] and document["packages"]["torch"] == torch.__version__
    assert document["cores"]["for_this_process"] >= 1 and document["memory"]["total"] > 1e8
    assert {"name", "for", "packages", "complete"} == document["extras"][0].keys()
    assert "synth" in {extra["name"] for extra in document["extras"]} and document["kernels"]["compile"]
    assert main(["doctor", "--weights", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert "GPU" in said.out and "compiled kernels" in said.out and "config.json" in said.err


BASH = """
source completion.sh
for words in "up" "update ''" "update work af" "update work after --estimate.ro" "update w p --estimate.route ''" \
    "train --quality d" "render work --cameras be" "visits work --j" "help"; do
  eval "COMP_WORDS=(refield $words)"
  COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
  _refield refield "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
  echo "$words -> ${COMPREPLY[*]}"
done
complete -p refield
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes(tmp_path, capsys):
    (tmp_path / "before").mkdir()
    assert main(["completion", "bash"]) == 0
    (tmp_path / "completion.sh").write_text(capsys.readouterr().out)
    done = subprocess.run(["bash", "-c", BASH], cwd=tmp_path, capture_output=True, text=True, check=True, env=HERE)
    assert done.stderr == ""
    *lines, how = done.stdout.splitlines()
    found = dict(line.split(" -> ") for line in lines)
    assert found == {
        "up": "update",
        "update ''": "",  # nothing but files: -o default
        "update work af": "",
        "update work after --estimate.ro": "--estimate.route",
        "update w p --estimate.route ''": "refield paper",
        "train --quality d": "draft",
        "render work --cameras be": "before",
        "visits work --j": "--json",
        "help": "",
    }
    assert how == "complete -o default -F _refield refield"


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_can_read_theirs(tmp_path, shell):
    text = script(shell)
    assert all(f"'{command}': {{" in text for command in COMMANDS) and "--estimate.models.segmenter" in text
    if program := shutil.which(shell):
        (tmp_path / "script").write_text(text)
        subprocess.run([program, "-n", str(tmp_path / "script")], check=True)


def test_doctor_opens_weights(tmp_path, capsys):
    transformers = pytest.importorskip("transformers", reason="the extra 'sam' is not installed")
    sizes = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 28, "patch_size": 14}
    model = transformers.Dinov2Model(transformers.Dinov2Config(**sizes))
    model.save_pretrained(tmp_path)
    capsys.readouterr()
    weights = told(capsys, "doctor", "--weights", str(tmp_path))["weights"]
    assert weights["model"] == "dinov2" and weights["parameters"] == sum(p.numel() for p in model.parameters())
