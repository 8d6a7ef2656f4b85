"""The boundary term where the chain needs it: objects that move, the robot's own body before its
camera, cameras with aimed pupils, spectrum and falloff, windows on the film and batches of
trajectories. Differences with common random numbers are the judge."""

import functools

import pytest
import torch

from codesign import backend, lens, pose, render
from codesign.errors import DomainError
from codesign.render import MitsubaScene
from scenes import silhouettes as silhouette_scenes
from tests.numbers import D, close, f64
from tests.render.differences import smooth_weights, to_twist
from tests.render.solids import area

SIZE_PX = 24
STEP = 2e-3
WEIGHT = smooth_weights(SIZE_PX)
START = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))


def judged(loss, many=512, seeds=(11, 12), per_px=12.0):
    """Relative L2 error of the boundary and the interior gradient of loss(twist [6], samples, seed,
    way, per_px) against differences, and the noise of these."""
    truths = []
    for seed in seeds:
        with torch.no_grad():
            ends = [
                [loss(sign * step, many, seed, "interior", per_px) for sign in (1, -1)]
                for step in STEP * torch.eye(6, dtype=D)
            ]
        truths.append(torch.stack([(ahead - behind) / (2 * STEP) for ahead, behind in ends]))
    truth = torch.stack(truths).mean(0)
    noise = float(torch.stack(truths).std(0).norm() / len(seeds) ** 0.5 / truth.norm())

    def error(way):
        found = [
            to_twist(lambda t, seed=seed: loss(t[0], many, seed + 10, way, per_px))
            for seed in seeds
        ]
        return float((torch.stack(found).mean(0) - truth).norm() / truth.norm())

    return error("boundary"), error("interior"), noise


scene, robot = functools.cache(silhouette_scenes.build), functools.cache(silhouette_scenes.robot)


def aside(twist):
    """Cubes before a camera that moves."""
    return scene("cubes"), START[None] @ pose.se3_exp(twist[None])


def mounted(twist):
    """The robot stands in the world with the camera on it; what moves is the mount, under which the
    world moves and the robot's own body too."""
    T_world_robot = pose.se3_exp(f64([[0.05, -1.2, 1.0, 0.0, 0.0, 0.1]]))
    T_robot_cam = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, -0.15))
    world = render.MovingScene(scene("cubes"), {"robot": (robot(), T_world_robot)})
    return world, T_world_robot @ (T_robot_cam @ pose.se3_exp(twist[None]))


def turned(twist):
    """An object that moves about its own axes, before a camera that rests."""
    place = pose.se3_exp(f64([[-0.1, -0.1, 0.95, 0.6, 0.2, 0.5]]))
    moved = robot(), place @ pose.se3_exp(twist[None])
    return render.MovingScene(scene("wall"), {"robot": moved}), START[None]


PINHOLE, TRACED = lens.Pinhole(11.0), lens.load("cooke-triplet").scaled(0.22).freeze()
COLOURS = lens.Spectrum.visible_FdC((1.0, 2.0, 1.0))
# two windows that overlap, off the middle of a sensor: the edges of each count in each
WINDOWS = render.Film(48, 36, 16, 14, 8.0 / SIZE_PX, ((6, 8), (14, 12)))


@pytest.mark.parametrize(
    ("of_twist", "optics", "options", "how"),
    [
        (aside, TRACED, {"aim": True}, {"many": 192}),  # each ray is aimed by several traces
        (aside, TRACED, {"falloff": True}, {"many": 384}),
        (aside, TRACED, {"spectrum": COLOURS}, {"many": 384}),
        (aside, TRACED, {"film": WINDOWS}, {}),
        (mounted, PINHOLE, {}, {}),
        (mounted, TRACED, {}, {}),
        (turned, TRACED, {}, {"seeds": (11, 12, 13, 14)}),
    ],
    ids=["aim", "falloff", "spectrum", "windows", "mount, pinhole", "mount, traced", "object"],
)
def test_the_gradient_to_what_moves_has_its_edges(of_twist, optics, options, how):
    def loss(twist, samples, seed, way, per_px):
        film = options.get("film") or render.Film(SIZE_PX, SIZE_PX, SIZE_PX, SIZE_PX, 8.0 / SIZE_PX)
        size = film.width_px, film.height_px
        camera = render.Camera(
            optics, *size, 8.0 / SIZE_PX, samples, seed, **{"film": film, **options}
        )
        frames = render.frames(camera, *of_twist(twist), way, per_px)
        return (WEIGHT[: size[1], : size[0]] * frames).double().mean()

    whole, plain, noise = judged(loss, **how)
    assert noise < (0.03 if of_twist is turned else 0.02)
    assert whole < 0.05
    assert plain > 0.2


def test_every_frame_is_looked_at_and_again_through_a_wider_lens():
    """A ball that sinks into the wall in the second of three frames; a picture with hard texels
    that only the wider of two lenses sees."""
    mi = backend.mitsuba()
    wall, ball = silhouette_scenes.build("wall"), silhouette_scenes.ball()
    camera = render.Camera(lens.Pinhole(11.0), 32, 32, 0.25, 4)
    places = torch.eye(4, dtype=D).repeat(3, 1, 1)
    places[:, :3, 3] = torch.tensor([[0.1, 1.6, 0.7], [0.1, 2.45, 0.7], [0.1, 1.6, 0.7]])
    world = render.MovingScene(wall, {"ball": (ball, places)})
    with pytest.raises(DomainError, match="of the jumps of radiance in frame 1 lie on no edge"):
        render.frames(camera, world, START.expand(3, 4, 4), gradient="boundary")
    picture = mi.Bitmap(silhouette_scenes.smooth(3, size=16))
    hard = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "nearest"}
    place = mi.ScalarTransform4f().translate([0.55, 1, 0.7]).rotate([1, 0, 0], 90).scale(0.2)
    board = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": hard}}
    scene = MitsubaScene({"board": board})
    narrow = camera.with_lens(lens.Pinhole(60.0))
    render.frames(narrow, scene, START[None], gradient="boundary")
    away = pose.look_at((0.05, -1.2, 1.0), (0.0, -3.0, 1.0))
    assert render.frames(camera, scene, away[None], gradient="boundary").abs().max() == 0.0
    with pytest.raises(DomainError, match="textures with hard texels"):
        render.frames(camera, scene, START[None], gradient="boundary")


def test_auto_sees_faint_edges_and_asks_the_rays_of_any_lens():
    """A card of one per cent more radiance than what is behind it; a lens that is no module and
    holds its focal length under a name of its own; a scene that cannot be a key."""

    class Plain:
        dtype = D

        def __init__(self, focal_mm):
            self.focal_mm = focal_mm

        def camera_rays(self, film_mm, pupil, **options):
            return lens.Pinhole(self.focal_mm).camera_rays(film_mm, pupil)

    class Own(MitsubaScene):
        __hash__ = None

    T = backend.mitsuba().ScalarTransform4f

    def sheet(level, away, scale):
        place = T().translate([0.05, away, 0.7]).rotate([1, 0.1, 0.2], 90).scale(scale)
        emitter = area(level)
        return {"type": "rectangle", "to_world": place, "emitter": emitter}

    scene = Own({"card": sheet(101.0, 1.0, 0.3), "wall": sheet(100.0, 2.0, 5.0)})
    focal_mm = torch.tensor(11.0, dtype=D, requires_grad=True)
    camera = render.Camera(Plain(focal_mm), 16, 16, 0.5, 4)
    found, truth = (
        torch.autograd.grad(
            render.frames(camera, scene, START[None], way).square().sum(), focal_mm
        )[0]
        for way in ("auto", "boundary")
    )
    assert truth.abs() > 0
    close(found, truth, rtol=1e-5)
