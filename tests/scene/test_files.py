"""Strict reading, safe names, and writing that is never seen half done."""

import json

import pytest
import torch

from refield.scene import ply
from refield.scene.errors import InputError
from refield.scene.files import inside, read_json, write_bytes, write_json


@pytest.mark.parametrize(
    "text, says",
    [
        ('{"a": NaN}', "NaN"),
        ('{"a": Infinity}', "Infinity"),
        ('{"a": 1e999}', "1e999"),
        ('{"a": 1, "a": 2}', "'a' is given twice"),
        ('{"a": ' + "[" * 100_000 + "]" * 100_000 + "}", "nested"),
        ("[1, 2]", "list"),
        ('{"a": ', "not valid JSON"),
        ("{'a': 1}", "not valid JSON"),
        ('{"a": ' + "9" * 5000 + "}", "not valid JSON"),
        ("", "not valid JSON"),
    ],
)
def test_json_that_is_refused(tmp_path, text, says):
    path = tmp_path / "t.json"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        read_json(path)
    assert "t.json" in str(caught.value)


def test_json_of_other_encodings(tmp_path):
    path = tmp_path / "t.json"
    path.write_bytes(b"\xef\xbb\xbf" + '{"ä": 1}'.encode())
    assert read_json(path) == {"ä": 1}
    path.write_bytes(b'{"a": "\xff\xfe"}')
    with pytest.raises(InputError, match="UTF-8"):
        read_json(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_json(tmp_path)


@pytest.mark.parametrize("name", ["", "../x", "a/../../x", "/etc/passwd", "a\0b", "link/x", "loop/x"])
def test_names_that_lead_out(tmp_path, name):
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    (root / "loop").symlink_to(root / "loop")
    with pytest.raises(InputError, match="frame 7"):
        inside(root, name, "frame 7")


def test_names_that_stay(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "to_b").symlink_to(tmp_path / "b")
    for name in ("a.png", "./a.png", "b/../a.png", "to_b/a.png", str(tmp_path / "a.png")):
        assert inside(tmp_path, name, "").is_relative_to(tmp_path.resolve())


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    with pytest.raises(TypeError):
        write_bytes(path, "text")  # type: ignore[arg-type]
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_point_clouds(tmp_path):
    points = torch.randn(17, 3)
    ply.write_points(tmp_path / "p.ply", points)
    assert torch.equal(ply.read_points(tmp_path / "p.ply"), points)
    rows = "\n".join(f"9 {x} {y} {z}" for x, y, z in points.tolist())
    head = "ply\nformat ascii 1.0\nelement vertex 17\nproperty uchar red\n"
    head += "".join(f"property float {a}\n" for a in "xyz") + "element face 0\nend_header\n"
    (tmp_path / "a.ply").write_text(head + rows + "\n")
    assert torch.allclose(ply.read_points(tmp_path / "a.ply"), points)
    for broken in (head.replace("property float z\n", "") + rows, "ply\n", head + rows[:40]):
        (tmp_path / "b.ply").write_text(broken)
        with pytest.raises(InputError, match=r"b\.ply"):
            ply.read_points(tmp_path / "b.ply")
