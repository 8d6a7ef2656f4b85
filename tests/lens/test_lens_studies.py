"""What the drawings of a lens show: true sags, rays that end where they are traced to, curves with
the values of the analysis; and the study on odd lenses."""

import json
import math
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Rectangle

from codesign import lens
from codesign.errors import FileFormatError
from codesign.lens import GeoLens, Surface, analysis
from codesign.lens.seidel import seidel_sums
from codesign.report import lens_curves, lens_figures
from codesign.report.lens_layout import ray_paths
from studies.frame.run import main
from studies.lens_report import __main__ as lens_report
from tests.lens.systems import close
from tests.numbers import f64
from tests.studies.browser import check_page


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def telescope():
    """A Cassegrain: 200 mm f/8, a paraboloid and a hyperboloid, its axis unfolded at both mirrors;
    no half field."""
    # primary f = 500 mm, secondary magnifies 3.2 times; k = -((m + 1) / (m - 1))^2 (Schroeder,
    # Astronomical Optics, ch. 2)
    m = 3.2
    f1 = 500.0
    gap = 380.0
    image = m * (f1 - gap)
    # of the secondary; convex, so it bends the other way than the primary
    radius = 2 * image / (m - 1)
    primary = Surface(
        -2 * f1,
        gap,
        None,
        100.0,
        conic=-1.0,
        is_stop=True,
        mirror=True,
        inner_semi_aperture_mm=25.0,
    )
    return GeoLens(
        [
            primary,
            Surface(radius, image, None, 40.0, conic=-(((m + 1) / (m - 1)) ** 2), mirror=True),
        ],
        200.0,
        name="cassegrain",
    )


def values(line, axis):
    return np.asarray(line.get_xdata() if axis == "x" else line.get_ydata())


def test_ray_paths_lie_on_the_surfaces_and_end_on_the_traced_points():
    geo = lens.load("double-gauss")
    field = math.radians(10.0)
    pupil = f64([[0.0, -0.6], [0.0, 0.0], [0.0, 0.7]])
    paths = ray_paths(geo, field, pupil, -10.0)
    end = analysis.trace_field(geo, field, pupil).position_mm[:, 1].detach().numpy()
    vertices = np.concatenate([[0.0], np.cumsum([s.thickness_mm for s in geo.surfaces])])
    assert len(paths) == 3
    for path, height in zip(paths, end, strict=True):
        assert path.shape == (13, 2)
        close(path[0, 0], -10.0, atol=1e-12)
        close(path[-1], [vertices[-1], height], atol=1e-9)
        for s, at, (z, y) in zip(geo.surfaces, vertices, path[1:], strict=False):
            c = s.curvature_per_mm
            # a sphere
            close(z - at, c * y * y / (1 + math.sqrt(1 - c * c * y * y)), atol=1e-9)


def test_a_layout_is_saved_by_its_ending(tmp_path):
    geo = lens.load("cooke-triplet")
    for name, start in (("a.svg", b"<?xml"), ("a.png", b"\x89PNG")):
        lens_figures.lens_layout(geo, path=tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(FileFormatError, match=r"extension '\.bmp' is not written"):
        lens_figures.lens_layout(geo, path=tmp_path / "a.bmp")
    with pytest.raises(FileFormatError, match="give a file in an existing, writable folder"):
        lens_figures.lens_layout(geo, path=tmp_path / "none" / "a.png")


def test_a_layout_says_that_mirrors_are_unfolded():
    figure = lens_figures.lens_layout(telescope(), [0.0, 0.002])
    assert [t.get_text() for t in figure.axes[0].texts] == [
        "mirrors (thick) along the unfolded axis"
    ]
    assert not lens_figures.lens_layout(lens.load("la1509"), [0.0]).axes[0].texts


def test_curves_carry_the_values_of_the_analysis():
    geo = lens.load("cooke-triplet")
    field = math.radians(20.0)
    figure = lens_curves.field_errors(geo, field, count=5)
    shown = values(figure.axes[0].lines[0], "x")[-1]
    assert shown == analysis.focus_shift_mm(geo, [field])[0, 0].item()
    assert (
        values(figure.axes[1].lines[0], "x")[-1] == analysis.distortion_percent(geo, [field]).item()
    )
    bars = lens_curves.seidel_bars(seidel_sums(geo, field)).axes[1].patches
    close(
        [b.get_height() for b in bars if isinstance(b, Rectangle)],
        seidel_sums(geo, field).total / 0.5875618e-3,
        1e-12,
    )
    fans = lens_figures.ray_fans(geo, [field])
    close(
        values(fans.axes[0].lines[0], "y")[-1],
        1e3 * analysis.ray_fan(geo, field, count=65).tangential_mm[-1].item(),
        1e-12,
    )
    encircled = values(lens_curves.encircled_curves(geo, [0.0]).axes[0].lines[0], "y")
    assert (encircled[0], encircled[-1]) == (0, 1)
    focus = values(lens_curves.through_focus(geo, [0.0], [-0.1, 0.0], 20.0).axes[0].lines[0], "y")
    close(focus[1], 1e3 * lens.rms_spot_mm(geo, [0.0]).item(), 1e-9)


@pytest.mark.parametrize("name", ["telescope", "vignetted"])
def test_the_report_of_odd_lenses(name, tmp_path, monkeypatch):
    if name == "telescope":
        geo = telescope()
        monkeypatch.setattr(lens_report.lens, "load", lambda _: geo)
    elif name == "vignetted":  # the full field is wider than its apertures
        surfaces = [
            replace(s, semi_aperture_mm=min(s.semi_aperture_mm, 4.5))
            for s in lens.load("cooke-triplet").surfaces
        ]
        geo = GeoLens(surfaces, 10.0, name="narrow", half_field_deg=40.0)
        monkeypatch.setattr(lens_report.lens, "load", lambda _: geo)
    assert (
        main(
            lens_report.study,
            lens_report.Config,
            ["--lens", name, "--quick", "--out", str(tmp_path / "run")],
        )
        == 0
    )
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    page = (tmp_path / "run" / "report.html").read_text()
    if name == "telescope":
        close(metrics["efl_mm"], 1600.0, 1e-12)
        assert metrics["rms_waves_0deg"] <= 1e-6  # a classical Cassegrain is perfect on its axis
        close(metrics["passed_share_0deg"], 1 - 0.25**2, atol=0.02)  # the obstruction
        assert "names no half field" in page
    else:
        assert "is left out: fewer than 5% of its rays arrive" in page
        assert "rms_spot_um_0deg" in metrics


def test_the_report_of_near_objects(tmp_path):
    command = [
        "--quick",
        "--half-field-deg",
        "8",
        "--at-m",
        "0.5",
        "2",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(lens_report.study, lens_report.Config, command) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    geo = lens.load("cooke-triplet").requires_grad_(False).focus_at(0.5, spot_grid=16)
    seen = [(math.radians(field), at_m) for at_m in (0.5, 2.0) for field in (0.0, 8.0)]
    spots = [
        1e3 * analysis.spot_radius_mm(*analysis.polychromatic_spot(geo, *each))
        for each in ((field, lens_figures.VISIBLE_UM, 32, True, at_m) for field, at_m in seen)
    ]
    names = ("0deg_at_0p5m", "8deg_at_0p5m", "0deg_at_2m", "8deg_at_2m")
    found = [metrics[f"rms_spot_um_{name}"] for name in names]
    close(found, spots, 1e-9)
    # the film is focused there: one number for one thing
    assert metrics["rms_spot_um_8deg"] == metrics["rms_spot_um_8deg_at_0p5m"]
    assert metrics["depth_of_field_near_m_traced"] < 0.5 < metrics["depth_of_field_far_m_traced"]
    close(
        metrics["seidel_spherical_waves"],
        float(seidel_sums(geo, math.radians(8.0), at_m=0.5).total[0]) / 0.5875618e-3,
        1e-9,
    )
    close(metrics["hyperfocal_m"], analysis.hyperfocal_m(geo, 0.02), 1e-12)
    assert "is focused on 0.5 m" in (tmp_path / "run" / "report.html").read_text()
    check_page("lens_report", tmp_path / "run")
