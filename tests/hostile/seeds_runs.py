"""Small whole files of runs, trainings, generators and hand-overs, and who reads each."""

import json
from pathlib import Path

import torch

from codesign import events, lens, plain_yaml, render
from codesign.events.spiking.spike_esim import SpikeEsim
from codesign.mount import Mount
from codesign.reading import read_json, read_text
from codesign.system import HandOver, load_hand_over, save_hand_over
from codesign.train import checkpoint
from codesign.train.loop import Progress
from studies.frame.run import Run, open_run
from tests.hostile.seeds_events import Seed, made
from tests.studies.smallest_study import Config


def run(folder: Path) -> Run[Config]:
    """A run with a state and a number."""
    begun = open_run("hostile", Config(out=folder / "run", device="cpu"))
    tensors = {"x": torch.arange(3.0), "g": torch.Generator().get_state()}
    begun.save_state(tensors, {"step": 3, "rows": {"a": [1.0]}})
    begun.record(loss=0.5)
    return begun


def resumed(path: Path):
    """The run beside a file that was changed: its configuration, numbers, and what its state
    names."""
    if path.name != "config.json" and not (path.parent / "config.json").exists():
        (path.parent / "config.json").write_bytes(made("config.json", run)())
    again = open_run("hostile", Config(resume=path.parent, device="cpu"))
    state = again.load_state()
    # a state may hold an infinite best
    names = sorted(state.tensors) if state else None
    return [again.config.limit, again.config.sizes, again.metrics, names]


class Learner:
    """Stands in for a training's."""

    def state_dict(self):
        return {"w": torch.ones(2)}

    def load_state_dict(self, tensors, path):
        pass


def training(folder: Path):
    """A checkpoint of three steps."""
    progress = Progress(3, 1.0, 2.0, 0.5, 0, 0, [1.0], [1.0], [0.1])
    checkpoint.save(folder, Learner(), progress, {"seed": 0})  # type: ignore[arg-type]


def trained(path: Path):
    """The numbers of a checkpoint whose tensors are whole."""
    if not list(path.parent.glob("*.safetensors")):
        content = path.read_bytes()
        training(path.parent)
        path.write_bytes(content)
    return checkpoint.load(path.parent, Learner(), {"seed": 0})  # type: ignore[arg-type]


def hand_over(folder: Path):
    """A mount with a thin lens and a sensor."""
    mount = Mount((0.2, 0.0, 0.4), (0.1, 0.0, 0.2), yaw_rad=0.3)
    camera = render.Camera(lens.ThinLens(8.0, 2.0).focus_at(1.3), 32, 24, 0.1, 4, falloff=True)
    given = HandOver(mount, camera, events.SensorModel(), notes={"by": "me"})
    save_hand_over(folder / "mount.yaml", given)


def handed(path: Path):
    """What has a meaning of a hand-over."""
    found = load_hand_over(path)
    names = [found.parent_frame, found.child_frame]
    assert all(isinstance(name, str) for name in names)
    assert isinstance(found.camera.falloff, bool)
    return [found.mount(), found.camera.film.pixel_pitch_mm, found.sensor]


SEEDS: dict[str, Seed] = {
    "config.json": (made("config.json", run), resumed),
    "state.npz": (made("state.npz", run), resumed),
    "metrics.json": (made("metrics.json", run), resumed),
    "checkpoint.json": (made("checkpoint.json", training), trained),
    "generator.npz": (
        made("g.npz", lambda folder: SpikeEsim().save(folder / "g.npz")),
        SpikeEsim.load,
    ),
    "mount.yaml": (made("mount.yaml", hand_over), handed),
    "page.yaml": (
        lambda: plain_yaml.dump({"a": {"b": [0.1, 2, "x"], "c": None}, "d": True}).encode(),
        lambda path: plain_yaml.load(read_text(path)),
    ),
    "page.json": (lambda: json.dumps({"a": [1, {"b": None}]}).encode(), read_json),
}
