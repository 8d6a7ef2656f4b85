"""The viewer: what a setting shows against the pair's own chain, what a slider touches, designs that
runs handed over, and the window."""

import json
import shutil
import socket
import subprocess
import sys
import time
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from codesign import render
from codesign.errors import FileFormatError, MissingPackageError
from codesign.grad import Row, certify
from codesign.system import HandOver, save_hand_over
from scenes.robots import pair as robot_pair
from scenes.robots.costs import Costs
from scenes.robots.pairs import PAIRS
from studies.codesign.design import Space
from studies.codesign.gallery import save
from studies.placement.figures import tiled
from studies.viewer import __main__ as viewer
from studies.viewer import window as window_of
from studies.viewer.certificate import certificate
from studies.viewer.opened import opened
from studies.viewer.state import SLIDERS, Drive, Setting
from studies.viewer.window import Window
from tests.studies.runs import page, ran

SIZE = 24


@pytest.fixture(scope="module")
def setting():
    space = Space.of("outdoors", None)
    return Setting.of(Drive.of(space, SIZE, frames=3), space.made(space.start))


@pytest.fixture
def window(setting):
    pytest.importorskip("viser")
    made = Window(setting, port=0)
    yield made
    made.server.stop()


def test_the_frame_is_that_of_one_film_without_windows(setting):
    drive, pair = setting.drive, setting.drive.space.pair
    lens = pair.camera(pair.design).lens
    pitch_mm = robot_pair.SENSOR_PX[1] * robot_pair.PITCH_MM / SIZE
    plain = render.Camera(lens, SIZE, SIZE, pitch_mm, drive.rays_per_px)
    poses = drive.batch.T_world_body[0] @ pair.design.mount()
    whole = render.frames(plain, drive.batch.scene[0], poses)[0, 1]
    windows = setting.run["frames"][0, 0, 1]
    np.testing.assert_allclose(tiled(windows.numpy()), whole.numpy(), rtol=1e-5)
    full = np.quantile(whole, 0.98)
    expected = 255 * np.clip(whole.numpy() / full, 0, 1) ** (1 / 2.2)
    assert np.abs(setting.frame() - expected).max() <= 1.01  # rounded down, by float32 rounding


def test_the_threshold_leaves_the_frames_and_makes_events_as_the_hard_sensor_does():
    space = Space(PAIRS["corridor"](), Costs(noise=False))
    first = Setting.of(Drive.of(space, SIZE), space.made(space.start))
    half = first.at(theta=first.whole.numbers["theta"] / 2)
    assert half.run["frames"] is first.run["frames"]
    assert first.at(fno=2.0).run["frames"] is not first.run["frames"]
    ours, single = [], []
    for each in (first, half):
        hard = each.run.system.replaced(events=each.whole.events("sensor"))
        with torch.no_grad():
            found = hard.begin(each.drive.batch, {"frames": first.run["frames"]})["volume"]
            ours.append(float(each.run["volume"].counts.sum()))
        single.append(float(found.counts.sum()))
    assert ours[1] > 2 * ours[0]
    # a standard deviation of the ratio of four independent counts
    deviation = sum(1 / count for count in (*ours, *single)) ** 0.5
    assert ours[1] / ours[0] == pytest.approx(single[1] / single[0], rel=deviation)


def test_rays_start_on_the_pupil_and_meet_where_the_lens_is_focused(setting):
    numbers = setting.whole.numbers
    lines = setting.rays()
    radius_m = 1e-3 * numbers["efl_mm"] / numbers["fno"] / 2
    across = np.linalg.norm(lines[:, 0, :2], axis=1).reshape(9, 5)
    np.testing.assert_allclose(across[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(across[:, 1:], radius_m, rtol=1e-6)
    slope = (lines[:, 1] - lines[:, 0])[:, :2] / (lines[:, 1] - lines[:, 0])[:, 2:]
    at_focus = lines[:, 0, :2] + slope / numbers["focus_per_m"]
    bundles = at_focus.reshape(9, 5, 2)
    np.testing.assert_allclose(bundles, bundles[:, :1].repeat(5, 1), atol=1e-6)


def test_the_loss_that_is_certified_has_the_slope_of_the_threshold(setting, monkeypatch):
    def of_threshold(loss, point, scales, **more):
        alone, unit = ({"threshold": each["threshold"]} for each in (point, scales))
        return certify(lambda p: loss({**point, **p}), alone, scales=unit, **more)

    monkeypatch.setattr("studies.viewer.certificate.certify", of_threshold)
    assert [row.verdict for row in certificate(setting)] == ["pass"]


def test_the_lens_that_is_certified_has_the_rays_of_the_setting(setting, monkeypatch):
    taken = []
    monkeypatch.setattr(
        "studies.viewer.certificate.certify", lambda loss, point, **_: taken.append((loss, point))
    )
    certificate(setting)
    loss, point = taken[0]
    as_it_is = {name: value for name, value in point.items() if name != "focus"}
    assert len(as_it_is) < len(point)
    assert float(loss(point)) == pytest.approx(float(loss(as_it_is)), rel=1e-5)


def test_designs_that_runs_handed_over_are_opened_as_they_are(tmp_path):
    space = Space.of("corridor", None, light=0.5)
    whole = space.made(space.share(z_m=0.5, fno=2.5, theta=0.3))
    save(tmp_path / "design.yaml", whole, {"error_unseen": 0.1})
    config = {"pair": "corridor", "robot": None, "family": "thin", "light": 0.5, "speed": 1.0}
    (tmp_path / "config.json").write_text(json.dumps(config))
    back = opened(tmp_path)
    assert dict(back.numbers) == dict(whole.numbers)
    assert back.space.costs.light == 0.5
    frames = [Setting.of(Drive.of(space, SIZE, 3), each).frame() for each in (whole, back)]
    np.testing.assert_array_equal(*frames)
    (tmp_path / "design.yaml").unlink()
    mount = robot_pair.mount_at(space.pair.ranges, whole.T_body_cam)
    save_hand_over(tmp_path / "mount.yaml", HandOver(mount, whole.camera))
    (tmp_path / "config.json").write_text(json.dumps({**config, "lens": None}))
    placed = opened(tmp_path)
    assert placed.numbers["z_m"] == pytest.approx(0.5, abs=1e-9)
    assert placed.numbers["fno"] == space.pair.design.fno
    (tmp_path / "config.json").write_text(json.dumps({**config, "lens": "cooke-triplet"}))
    assert not {"fno", "focus_per_m"} & set(opened(tmp_path).space.free)
    with pytest.raises(FileFormatError, match=r"has no design\.yaml and no mount\.yaml; give the"):
        opened(tmp_path / "nothing")


def test_a_slider_moves_the_camera_by_as_many_metres(window, setting):
    with urlopen(f"http://127.0.0.1:{window.port}", timeout=20) as answer:
        assert answer.status == 200
    before = np.array(window.camera.position)
    slider = window.sliders["x_m"]
    slider.value += 0.05
    frames = setting.run["frames"]
    window.update()
    moved = np.array(window.camera.position) - before
    np.testing.assert_allclose(moved, [0.05, 0, 0], atol=1e-9)
    assert window.setting.run["frames"] is not frames
    enlarged = window_of.ENLARGED
    shown = window.pictures["frame"].image[::enlarged, ::enlarged, 0]
    np.testing.assert_array_equal(shown, window.setting.frame())
    assert len(window.update_s) == 1


def test_the_first_line_says_what_was_seen_and_how_many_updates_a_second(tmp_path, monkeypatch):
    pytest.importorskip("viser")
    assert viewer.headline("12 events", [0.1, 0.5, 4.0]) == (
        "The camera sees 12 events; 2.0 updates a second (median of 3)."
    )
    seen = []
    monkeypatch.setattr(Window, "serve", lambda window: seen.append(window.setting.words()))
    assert ran(viewer, f"--size {SIZE} --frames 3 --port 0 --out", tmp_path / "run") == 0
    assert f"The camera sees {seen[0]}; no slider was moved." in page(tmp_path / "run")


def test_the_button_shows_the_verdict_of_the_certificate(window, monkeypatch):
    def square(p):
        return p["right"].square().sum() + p["wrong"].detach() * p["wrong"]

    point = {name: torch.tensor(1.0, dtype=torch.float64) for name in ("right", "wrong")}
    monkeypatch.setattr(window_of, "certificate", lambda _: certify(square, point))
    window.certify()
    assert "| right | **pass** |" in window.verdict.content
    assert "| wrong | **fail** |" in window.verdict.content


@pytest.mark.parametrize(
    ("verdicts", "said"),
    [
        ({"pose": "pass", "threshold": "pass", "focus": "pass"}, False),
        ({"pose": "fail", "threshold": "pass", "focus": "pass"}, True),
        ({"pose": "pass", "threshold": "pass", "focus": "noise"}, True),
        ({"pose": "pass", "threshold": "fail"}, False),  # no ray moves over a texel
    ],
)
def test_a_result_that_kinks_may_have_made_says_so_and_what_to_do(
    window, monkeypatch, verdicts, said
):
    numbers = {"autograd": (1.0,), "difference": (1.0,), "relative_error": 0.1, "cosine": 1.0}
    numbers |= {"signed_bias": 0.1, "noise_floor": 0.01, "step_plateau": (0.1,)}
    rows = [Row(name, **numbers, verdict=verdict) for name, verdict in verdicts.items()]
    monkeypatch.setattr(window_of, "certificate", lambda _: rows)
    window.certify()
    *_, table, last = window.verdict.content.split("\n\n")
    lines = [f"| {name} | **{verdict}** |" for name, verdict in verdicts.items()]
    shown = last if not said else table
    assert [
        line[: len(each)] for each, line in zip(lines, shown.splitlines()[2:], strict=True)
    ] == lines
    assert ("not yet proof of a wrong gradient" in last) == said
    assert ("without fine detail, with more rays (`--rays`)" in last) == said


def test_a_port_in_use_and_a_missing_viser_are_one_sentence(tmp_path, capsys, monkeypatch, setting):
    pytest.importorskip("viser")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert ran(viewer, f"--size {SIZE} --port {port} --out", tmp_path / "run") == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"error: port {port} is in use; give another one")
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackageError, match=r"the viewer needs viser; install it with: pip"):
        Window(setting, 0)


def test_a_click_in_a_browser_asks_for_the_certificate(window, tmp_path):
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("there is no chromium to look at the page with")
    options = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage"]
    options += ["--remote-debugging-port=0", f"--user-data-dir={tmp_path}"]
    page = f"http://127.0.0.1:{window.port}"
    with subprocess.Popen([browser, *options, page], stderr=subprocess.PIPE, text=True) as process:
        try:
            line = next(each for each in process.stderr or () if "DevTools listening" in each)
            clicked(line.split("/")[2], window)
        finally:
            process.terminate()


def clicked(debugger, window):
    """Wait for the page, press its button, and see that the window was asked."""
    from websockets.sync.client import connect

    with urlopen(f"http://{debugger}/json/list", timeout=20) as answer:
        target = next(each for each in json.load(answer) if each["type"] == "page")
    press = "[...document.querySelectorAll('button')].find(b => b.innerText == 'certify here')"
    with connect(target["webSocketDebuggerUrl"], max_size=None) as socket_of:

        def said(expression):
            call = {"method": "Runtime.evaluate", "params": {"expression": expression}}
            socket_of.send(json.dumps({"id": 1, **call}))
            return json.loads(socket_of.recv(timeout=60))["result"]["result"].get("value")

        deadline = time.monotonic() + 90
        while not window._asked.is_set() and time.monotonic() < deadline:
            said(f"{press}?.click()")
            time.sleep(0.2)
        shown = said("document.body.innerText")
    assert window._asked.is_set()
    assert all(SLIDERS[name] in shown for name in window.sliders)
