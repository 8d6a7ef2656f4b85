"""The viewer's window in a browser: a scene, pictures and sliders, served by viser."""

import logging
import threading
import time
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from codesign.errors import CodesignError, DomainError
from codesign.optional import optional
from studies.viewer.certificate import certificate
from studies.viewer.state import SLIDERS, Setting

viser = optional("viser", "viewer", "the viewer")
trimesh = optional("trimesh", "viewer", "the viewer")

HOST = "127.0.0.1"  # this machine alone
STEPS = 200  # of a slider
ENLARGED = 2  # pixels of a picture, a side
VIEW_M = 0.25  # size of the camera's cone
RAY_COLOUR = (220, 60, 40)
KINKS = (  # of pose and focus, which move rays over texels
    "Pose or focus that does not pass is not yet proof of a wrong gradient: where texels are finer "
    "than a pixel and rays few, the slope changes within a step; certify again before textures "
    "without fine detail, with more rays (`--rays`)."
)


class Window:
    """A setting in a browser; ``serve`` follows the sliders.

    setting: what is shown. port: where it is served; of 0 the system chooses.
    update_s: seconds by the clock of every update so far.
    Raises: DomainError when the port is taken; MissingPackageError without viser.
    """

    def __init__(self, setting: Setting, port: int = 8080) -> None:
        self.setting = setting
        self.update_s: list[float] = []
        self._shown: dict[str, Any] = {}
        self._changed = threading.Event()
        self._asked = threading.Event()
        # browsers open connections that they never use, each a traceback
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.server = viser.ViserServer(HOST, port, verbose=False)
        self.port: int = self.server.get_port()
        if port not in (0, self.port):
            self.server.stop()
            raise DomainError(
                f"port {port} is in use; give another one, such as --port {self.port}."
            )
        self._scene()
        self._panel()
        self.show()

    def _scene(self):
        scene, drive = self.server.scene, self.setting.drive
        scene.set_up_direction("+z")
        vertices, faces, grey = drive.world()
        colours = np.stack([grey] * 3, 1)
        world = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
        scene.add_mesh_trimesh("/world", world)
        wxyz, position = _placed(drive.T_world_body)
        scene.add_frame("/robot", axes_length=0.15, axes_radius=0.004, wxyz=wxyz, position=position)
        for name, mesh in drive.space.pair.bodies.items():
            part = name.replace(" ", "-")
            scene.add_mesh_simple(
                f"/robot/{part}", np.float32(mesh.vertices_m), mesh.faces, side="double"
            )
        self.camera = scene.add_frame("/robot/camera", show_axes=False)
        start = position + Rotation.from_quat(wxyz, scalar_first=True).apply([-1.3, -1.0, 0.9])
        self.server.initial_camera.position = start
        self.server.initial_camera.look_at = position

    def _panel(self):
        gui, setting = self.server.gui, self.setting
        self.words = gui.add_markdown("")
        self.sliders = {}
        for name in setting.drive.names:
            low, high = setting.drive.space.limits(name)
            now = min(max(setting.whole.numbers[name], low), high)
            slider = gui.add_slider(SLIDERS[name], low, high, (high - low) / STEPS, now)
            slider.on_update(lambda _: self._changed.set())
            self.sliders[name] = slider
        self._taken = {name: slider.value for name, slider in self.sliders.items()}
        blank = np.zeros((ENLARGED, ENLARGED, 3), np.uint8)
        self.pictures = {
            name: gui.add_image(blank, label=name) for name in ("frame", "events", "flow")
        }
        gui.add_button("certify here").on_click(lambda _: (self._asked.set(), self._changed.set()))
        self.verdict = gui.add_markdown("")

    def serve(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            self.update()
            if self._asked.is_set():
                self._asked.clear()
                self.certify()

    def update(self) -> dict[str, float]:
        """Take the numbers of the sliders that moved and show what they change; returns the
        processor seconds of every stage and of drawing, those of this process."""
        values = {name: slider.value for name, slider in self.sliders.items()}
        moved = {name: value for name, value in values.items() if value != self._taken[name]}
        began = time.perf_counter()
        try:
            self.setting = self.setting.at(**moved)
            self._taken = values
            spent = self.show()
            self.update_s.append(time.perf_counter() - began)
            return spent
        except CodesignError as error:
            self.words.content = f"error: {error}"
            return {}

    def show(self) -> dict[str, float]:
        """Put what the setting has anew into the window, picture after picture."""
        steps = {
            "frames": self._camera_and_frame,
            "volume": lambda: self._picture("events", self.setting.events()),
            "field": lambda: self._picture("flow", self.setting.flow()),
            "estimate": lambda: setattr(self.words, "content", self.setting.words()),
        }
        spent = dict.fromkeys((*steps, "drawing"), 0.0)
        for stage, draw in steps.items():
            began = time.process_time()
            with torch.no_grad():
                found = self.setting.run[stage]
            made = time.process_time()
            if found is not self._shown.get(stage):
                draw()
            self._shown[stage] = found
            spent[stage] = made - began
            spent["drawing"] += time.process_time() - made
        return spent

    def _camera_and_frame(self):
        scene, setting = self.server.scene, self.setting
        frame = np.stack([setting.frame()] * 3, -1)
        self.camera.wxyz, self.camera.position = _placed(setting.whole.T_body_cam)
        scene.add_line_segments(
            "/robot/camera/rays", np.float32(setting.rays()), RAY_COLOUR, thickness=0.002
        )
        scene.add_camera_frustum(
            "/robot/camera/view",
            setting.view_rad(),
            1.0,
            scale=VIEW_M,
            thickness=0.003,
            image=frame,
        )
        self._picture("frame", frame)

    def _picture(self, name, colours):
        self.pictures[name].image = colours.repeat(ENLARGED, 0).repeat(ENLARGED, 1)

    def certify(self) -> None:
        """Certify the gradient at the setting that is shown, and show the verdicts."""
        self.verdict.content = "Certifying: this takes a while."
        try:
            rows = certificate(self.setting)
        except CodesignError as error:
            self.verdict.content = f"error: {error}"
            return
        lines = [
            f"| {row.name} | **{row.verdict}** | {row.relative_error:.1e} | {row.noise_floor:.0e} |"
            for row in rows
        ]
        heads = "| gradient of | verdict | error | noise |\n|---|---|---|---|\n"
        doubted = any(row.verdict != "pass" for row in rows if row.name != "threshold")
        table = f"At {self.setting.whole}:\n\n{heads}" + "\n".join(lines)
        self.verdict.content = f"{table}\n\n{KINKS}" if doubted else table


def _placed(T: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion (w, x, y, z) and position of a pose [4, 4]."""
    rotation = Rotation.from_matrix(T[:3, :3].numpy())
    return rotation.as_quat(scalar_first=True), T[:3, 3].numpy()
