"""Silhouettes: gradients of frames with occluders against differences with common random numbers,
outlines against closed forms."""

import math

import pytest
import torch

from codesign import backend, lens, pose, render
from codesign.lens import Pinhole, ThinLens
from codesign.render import MitsubaScene
from codesign.render.charts import glowing
from codesign.render.moving import views_of
from codesign.render.sequence import cheapest
from codesign.render.silhouettes.curve_points import places as _places
from scenes import silhouettes as silhouette_scenes
from studies.gradient_flow.silhouettes import STEPS, Task
from tests.numbers import D, close, f64
from tests.render.differences import smooth_weights, to_twist
from tests.render.solids import area


# the differences' samples know the truth to 1 to 2 %, 32 samples per pixel of edge add as much
@pytest.mark.parametrize(
    ("scene", "kind", "of", "samples", "without", "within"),
    [
        ("cubes", "pinhole", "pose", 1024, 0.2, 0.05),
        ("spheres", "traced", "pose", 1024, 0.2, 0.05),
        ("poles", "thin", "pose", 1024, 0.2, 0.05),
        ("fence", "traced", "pose", 1024, 0.2, 0.05),
        # three curvatures and three thicknesses, the last of which is the focus
        ("cubes", "traced", "lens", 2048, 0.15, 0.06),
    ],
)
def test_gradients_with_occluders(scene, kind, of, samples, without, within):
    """Six numbers together."""
    task = Task(silhouette_scenes.build(scene), kind)
    scale = f64(STEPS[of])
    truth = torch.stack([task.differences(of, samples, seed) for seed in (11, 12)]).mean(0) * scale
    plain, whole = (
        task.gradient(of, 1024, 13, way, 32.0) * scale for way in ("interior", "boundary")
    )
    assert (plain - truth).norm() / truth.norm() > without
    assert (whole - truth).norm() / truth.norm() < within


def test_an_outline_moves_through_a_wide_fast_lens_as_its_rays_do():
    """Off its axis the real pupil lies far from the paraxial one, from where light would miss the
    lens, and where one face of this prism of 32 sides is seen edge-on. The truth counts the rays of
    a corner of the film that have corners of the prism on both their sides."""
    angle = (2 * torch.arange(32, dtype=D)[:, None] + 1) * math.pi / 32
    face = torch.tensor([0.95, 1.0], dtype=D) / math.hypot(0.95, 1.0)  # y and z
    out = face.flip(0) * torch.tensor([-1.0, 1.0])
    rim = 0.18 * face + 0.1 * (angle.sin() * face + (angle.cos() - math.cos(math.pi / 32)) * out)
    a, b = (torch.nn.functional.pad(rim, (1, 0), value=x) for x in (-1.0, 0.0))
    c, d = (end.roll(-1, 0) for end in (a, b))
    scene = glowing(torch.cat([torch.stack([a, b, d], 1), torch.stack([a, d, c], 1)]))
    film = render.Film(346, 260, 32, 32, 18.5e-3, ((0, 228),))

    def camera(efl_mm, samples):
        wide = lens.family("retrofocus-4").lens(efl_mm, 1.5, 5.4, 0.3)
        return render.Camera(wide, 32, 32, 18.5e-3, samples, film=film)

    def covered(down_m, efl_mm):
        rays = camera(efl_mm, 256).rays()
        y, z = (rim - rays.origin_m[:, None, 1:]).unbind(2)
        side = rays.direction[:, 1:2] * z - rays.direction[:, 2:] * (y - down_m)
        return float((rays.weight * (side.amin(1) * side.amax(1) < 0)).mean())

    efl_mm = torch.tensor(2.6, dtype=D, requires_grad=True)
    twist = torch.zeros(1, 6, dtype=D, requires_grad=True)
    seen = render.frames(camera(efl_mm, 64), scene, pose.se3_exp(twist), "boundary", 20.0)
    moved, zoomed = torch.autograd.grad(seen.double().mean(), (twist, efl_mm))
    # about a pixel of motion; 600 points of the outline and 10,000 rays between know both to 1 %
    down = (covered(1e-3, 2.6) - covered(-1e-3, 2.6)) / 2e-3
    zoom = (covered(0, 2.61) - covered(0, 2.59)) / 0.02
    assert float(moved[0, 1]) == pytest.approx(down, rel=0.04)
    assert float(zoomed) == pytest.approx(zoom, rel=0.04)


def test_a_bright_square_moves_by_its_closed_form():
    """A square of radiance 100 alone before a pinhole: sideways the sum of all pixels stays, a
    weighted one gains radiance times length times motion on both sides."""
    place = (
        backend.mitsuba().ScalarTransform4f().translate([0.013, 0.021, 2.0]).rotate([0, 1, 0], 180)
    )
    emitter = area(100.0)
    scene = MitsubaScene(
        {"square": {"type": "rectangle", "to_world": place.scale(0.2), "emitter": emitter}}
    )
    camera = render.Camera(Pinhole(11.0), 32, 32, 0.25, 16)
    total, first = (
        to_twist(
            lambda t, w=w: (
                render.frames(camera, scene, pose.se3_exp(t), "boundary").double() * w
            ).sum()
        )
        for w in (torch.ones(32), torch.arange(32.0))
    )
    px_per_m = 11.0 / 0.25 / 2.0
    side = 0.4 * px_per_m  # 8.8 px
    assert abs(total[0]) < 1e-6 * 100 * side * px_per_m  # the two sides cancel
    # the sides lie in columns 11 and 20, whose weights they carry; points at equal shares of an
    # edge sum a constant exactly
    assert float(first[0]) == pytest.approx(-100 * side * (20 - 11) * px_per_m, rel=1e-6)
    # nearer by dz: the area grows by 2 dz / z
    assert float(total[2]) == pytest.approx(2 * 100 * side**2 / 2.0, rel=1e-4)
    # so it does by 2 ds / s when the film goes back; by differences whose step sweeps samples, a
    # thousand per pixel and a tenth of a pixel on both sides
    away_mm = torch.tensor(11.0, dtype=D, requires_grad=True)
    camera = render.Camera(ThinLens(11.0, 0.0, away_mm), 32, 32, 0.25, 1024)
    frames = render.frames(camera, scene, torch.eye(4, dtype=D)[None], "difference")
    (found,) = torch.autograd.grad(frames.double().sum(), away_mm)
    assert float(found) == pytest.approx(2 * 100 * side**2 / 11.0, rel=0.03)


# half a turn of the pupil draws other points: 32 per pixel of edge agree to about 2 %
@pytest.mark.parametrize(
    ("side", "pupil_mm", "film_mm", "within"), [(1, 2.0, 14.0, 1e-6), (-1, 20.0, 11.3, 0.05)]
)
def test_a_lens_with_an_intermediate_image_has_the_gradient_of_the_picture_turned(
    side, pupil_mm, film_mm, within
):
    """A ball of which only the blur reaches the film, and one seen through a lens wide enough to see
    around it."""
    thin = ThinLens(11.0, pupil_mm, film_mm)

    class Relay:
        entrance_pupil_diameter_mm = pupil_mm

        def camera_rays(self, at_mm, pupil, **options):
            return thin.camera_rays(-at_mm, side * pupil, **options)

    ball = {"type": "sphere", "center": [0.02, 0.05, 2.0], "radius": 0.2, "emitter": area(100.0)}
    scene = MitsubaScene({"ball": ball})
    weight = torch.arange(256.0).reshape(16, 16)

    def loss(twist, optics, weight):
        camera = render.Camera(optics, 16, 16, 0.15, 16)
        return (render.frames(camera, scene, pose.se3_exp(twist), "boundary", 32.0) * weight).sum()

    truth = to_twist(lambda t: loss(t, thin, weight.flip(0, 1)))
    error = to_twist(lambda t: loss(t, Relay(), weight)) - truth
    assert error.norm() < within * truth.norm()


def test_auto_takes_the_cheapest_way_that_agrees():
    scene = silhouette_scenes.build("cubes")
    wall = silhouette_scenes.build("wall")
    task = Task(scene, "pinhole")
    camera = render.Camera(task.lens, 24, 24, 0.33, 64)
    path = (task.pose @ pose.se3_exp(torch.zeros(1, 6, dtype=D))).detach().requires_grad_(True)
    # a look at a bare wall says nothing about another view of the same scene
    behind = pose.look_at((0.05, -1.2, 1.0), (0.0, -3.0, 1.0))[None].requires_grad_(True)
    assert cheapest(camera, views_of(scene, behind)) == "interior"
    assert cheapest(camera, views_of(wall, path)) == "interior"
    assert cheapest(camera, views_of(scene, path)) == "boundary"
    frames = render.frames(camera, scene, path, gradient="auto")
    expected = render.frames(camera, scene, path, gradient="boundary")
    (found,), (truth,) = (torch.autograd.grad(f.square().mean(), path) for f in (frames, expected))
    close(found, truth, rtol=1e-5, atol=1e-5 * float(truth.norm()))


@pytest.mark.parametrize(
    "lengths_px", [(0.3, 0.05, 1e-4, 0.39), (5.0, 0.01, 0.19, 0.7, 0.3), (2.0, 3.3), (0.01,)]
)
def test_points_on_curves_stand_for_their_whole_length(lengths_px, generator):
    """Shares times lengths add up to the length of all pieces, however short, since what is
    constant along them is to be summed exactly; points on the short ones lie evenly along their
    total length."""
    length = f64(lengths_px).repeat(30)
    piece, inside, share = _places(length, 2.5, generator)
    assert ((inside >= 0) & (inside <= 1)).all()
    assert float((share * length[piece]).sum()) == pytest.approx(float(length.sum()), rel=1e-12)
    short = length < 0.4
    of_long = torch.zeros_like(length).index_add(0, piece, share)[~short]
    close(of_long, torch.ones_like(of_long), rtol=1e-12)
    if bool(short.any()):
        before = torch.where(short, length, 0).cumsum(0) - length
        mine = short[piece]
        at = (before[piece] + inside * length[piece])[mine]
        assert len(at) == math.ceil(2.5 * float(length[short].sum()) - 1e-9)
        gaps = at.sort().values.diff()
        close(gaps, torch.full_like(gaps, float(length[short].sum()) / len(at)), atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_differences_step_by_a_share_of_a_pixel_in_small_scenes(scale):
    """A cube before a wall, in metres and in millimetres: the same picture, so gradients to
    translations are as one over the scale, and turns alike."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f().scale(scale)

    def shape(kind, place, seed):
        picture = mi.Bitmap(silhouette_scenes.smooth(seed, cycles=2))
        light = {"type": "area", "radiance": {"type": "bitmap", "bitmap": picture, "raw": True}}
        return {"type": kind, "to_world": place, "emitter": light}

    wall = shape("rectangle", T.translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(4), 1)
    cube = shape("cube", T.translate([0.1, 0.2, 2]).rotate([1, 2, 0.5], 40).scale(0.3), 2)
    scene = MitsubaScene({"wall": wall, "cube": cube})
    camera = render.Camera(Pinhole(11.0), 24, 24, 0.33, 256)
    weight = smooth_weights(24).double()
    unit = f64([scale] * 3 + [1.0] * 3)

    found, truth = (
        unit
        * to_twist(
            lambda t, way=way: (render.frames(camera, scene, pose.se3_exp(t), way) * weight).sum()
        )
        for way in ("difference", "boundary")
    )
    assert (found - truth).norm() / truth.norm() < 0.1
