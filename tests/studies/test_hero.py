"""The loop that the README shows: the way that is driven, the answer that is shown, the file."""

import io
import math

import pytest
import torch
from PIL import Image

from codesign.errors import DomainError
from studies import hero
from studies.codesign.design import Space
from studies.codesign.race import answers


def test_the_robot_drives_a_circle_of_the_speed_and_turn_asked_for():
    config = hero.Config(speed=0.8, turn=0.4, pictures=5)
    poses, twist = hero.driving(Space.of("outdoors", None), config).pair.drive(600, 5)
    assert twist.tolist() == [[0.8, 0, 0, 0, 0, 0.4]] * 5
    middle = poses[:, poses.shape[1] // 2, :3, 3]
    radius_m, angle = 0.8 / 0.4, 0.4 * hero.STEP_S * torch.arange(5)
    chord_m = 2 * radius_m * torch.sin(angle / 2)
    assert torch.allclose((middle - middle[0]).norm(dim=1), chord_m.double(), atol=1e-9)
    assert torch.allclose(middle[:, 2], middle[0, 2].expand(5), atol=1e-9)


def test_the_answer_in_the_middle_by_its_error_is_shown():
    space = Space.of("outdoors", None, free=("efl_mm",))
    rows = [
        {"arm": "joint", "share": [share], "errors": [error - 0.1, error + 0.1]}
        for share, error in ((0.1, 0.4), (0.2, 0.2), (0.3, 0.3))
    ]
    whole, error = hero.median(rows, "joint", space)
    low, high = space.limits("efl_mm")
    assert whole.numbers["efl_mm"] == pytest.approx(low * (high / low) ** 0.3)
    assert error == pytest.approx(0.3)
    with pytest.raises(DomainError, match="--arm book: no answer"):
        hero.median(rows, "book", space)


def test_the_loop_has_every_picture_and_no_end():
    pictures = [Image.new("RGB", (32, 16), (80 * k, 0, 0)) for k in range(3)]
    with Image.open(io.BytesIO(hero.looped(pictures))) as read:
        assert (read.n_frames, read.info["loop"], read.size) == (3, 0, (32, 16))
        read.seek(2)
        red = read.convert("RGB").getpixel((16, 8))[0]
    assert math.isclose(red, 160, abs_tol=6)


def test_published_answers_are_found_from_another_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    setting, rows = answers(hero.Config().answers)
    assert setting["pair"] == "outdoors"
    assert {"default", "nested"} <= {row["arm"] for row in rows}
